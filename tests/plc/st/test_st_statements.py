"""Statements, POUs and types of Structured Text, and errors with line and column."""

from __future__ import annotations

import json

import msgspec
import pytest
from st_bench import program, run, scan

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.gateway.core.values import Quality, Reason, TagValue
from fieldtwin.plc.binding import BoundProgram
from fieldtwin.plc.blocks import BLOCKS as STANDARD_BLOCKS
from fieldtwin.plc.cycle.scan import failed
from fieldtwin.plc.program import ProgramFailed, Role


def test_if_takes_the_first_branch_that_holds() -> None:
    for n, expected in ((1, 10), (2, 20), (3, 30)):
        body = f"n := {n}; IF n = 1 THEN r := 10; ELSIF n = 2 THEN r := 20; ELSE r := 30; END_IF"
        assert run("n, r : INT;", body)["r"] == expected


def test_case_by_number_range_and_name() -> None:
    types = "TYPE Light : (red, amber := 7, green); END_TYPE"
    body = """CASE n OF 1, 3: r := 1; 5..8: r := 2; -2: r := 4; ELSE r := 3; END_CASE
              CASE l OF red: l := amber; Light#amber: l := green; green: l := red; END_CASE"""
    got = {n: run(f"n : INT := {n}; r : INT; l : Light := amber;", body, types) for n in (1, 3, 5, 8, 9, -2)}
    assert {n: v["r"] for n, v in got.items()} == {1: 1, 3: 1, 5: 2, 8: 2, 9: 3, -2: 4}
    assert got[1]["l"] == 8


def test_loops_with_exit_and_continue() -> None:
    assert run("i, s : INT;", "FOR i := 10 TO 1 BY -3 DO s := s + i; END_FOR")["s"] == 10 + 7 + 4 + 1
    assert (
        run(
            "i, s : INT;",
            "FOR i := 1 TO 9 DO IF i = 3 THEN CONTINUE; END_IF; IF i = 6 THEN EXIT; END_IF; s := s + i; END_FOR",
        )["s"]
        == 12
    )
    assert (
        run("i, s : INT;", "WHILE i < 5 DO i := i + 1; IF i = 2 THEN CONTINUE; END_IF; s := s + i; END_WHILE")["s"]
        == 13
    )
    assert (
        run("i, s : INT;", "REPEAT i := i + 1; IF i < 4 THEN CONTINUE; END_IF; s := s + i; UNTIL i >= 5 END_REPEAT")[
            "s"
        ]
        == 9
    )
    assert run("i : INT; j : INT;", "FOR i := 5 TO 1 DO j := 1; END_FOR")["j"] == 0


def test_arrays_and_structures_are_values_not_references() -> None:
    types = "TYPE P : STRUCT x : INT := 3; a : ARRAY[1..2] OF INT := [7, 8]; END_STRUCT; END_TYPE"
    body = "q := p; q.x := 9; q.a[1] := 1; c := b; c[0, 2] := 5; r := p.x * 1000 + p.a[1] * 10 + b[0, 2];"
    got = run("p, q : P; b, c : ARRAY[0..1, 1..2] OF INT := [1, 2, 2(4)]; r : INT;", body, types)
    assert got["r"] == 3000 + 70 + 2
    assert got["c"] == [[1, 5], [4, 4]]
    assert (got["q"].m_x, got["q"].m_a) == (9, [1, 8])


def test_bits_of_integers_and_bit_strings() -> None:
    got = run("b : BYTE := 16#0F; i : SINT; r : BOOL;", "b.7 := TRUE; b.0 := FALSE; i.7 := TRUE; r := b.1;")
    assert (got["b"], got["i"], got["r"]) == (0x8E, -128, True)


FUNCTIONS = """
FUNCTION Divide : INT
VAR_INPUT a : INT; b : INT := 2; END_VAR
VAR_OUTPUT rest : INT; END_VAR
VAR_IN_OUT calls : INT; END_VAR
  calls := calls + 1;
  IF b = 0 THEN Divide := -1; RETURN; END_IF
  rest := a MOD b;
  Divide := a / b;
END_FUNCTION
"""


def test_functions_by_name_by_order_with_outputs_and_in_outs() -> None:
    body = """x := Divide(7, 3, n); y := Divide(a := 9, calls := n, rest => r) + Divide(a := 1, b := 0, calls := n);
              WHILE Divide(n, 1, n) < 6 DO k := k + 1; END_WHILE"""
    got = run("n, x, y, r, k : INT;", body, FUNCTIONS)
    assert (got["x"], got["y"], got["r"]) == (2, 3, 1)
    assert got["n"] == 6 + 1
    assert got["k"] == 3


BLOCKS = """
TYPE Pair : STRUCT a, b : DINT; END_STRUCT; END_TYPE
FUNCTION_BLOCK Count
VAR_INPUT by : DINT := 1; END_VAR
VAR_OUTPUT total : DINT; high : BOOL; END_VAR
VAR_IN_OUT pair : Pair; n : INT; END_VAR
VAR_TEMP t : DINT; END_VAR
  t := t + by;
  total := total + t;
  pair.a := total;
  n := n + 1;
  high := total > 5;
END_FUNCTION_BLOCK
"""


def test_function_blocks_keep_their_state_and_inputs_keep_their_value() -> None:
    body = (
        "c[1](by := 4, pair := p, n := k, high => h); c[1](pair := p, n := k, NOT high => l); c[2](pair := q, n := k);"
    )
    got = run("c : ARRAY[1..2] OF Count; p, q : Pair; k : INT; h, l : BOOL;", body, BLOCKS)
    assert (got["c"][0].v_total, got["c"][1].v_total, got["k"]) == (8, 1, 3)
    assert (got["p"].m_a, got["q"].m_a, got["h"], got["l"]) == (8, 1, False, False)


def test_standard_blocks_see_the_scans_time() -> None:
    made = program(
        "PROGRAM p VAR_INPUT go : BOOL; END_VAR VAR_OUTPUT q : BOOL; END_VAR VAR t : TON; END_VAR "
        "t(IN := go, PT := T#25ms); q := t.Q; END_PROGRAM"
    )
    seen = []
    for number in range(1, 6):
        made.go = True  # type: ignore[attr-defined]
        scan(made, number)
        seen.append(made.q)  # type: ignore[attr-defined]
    assert seen == [False, False, False, True, True]


def test_globals_constants_and_first_scan() -> None:
    text = """VAR_GLOBAL n : INT := 5; END_VAR VAR_GLOBAL CONSTANT top : INT := 3; END_VAR
    FUNCTION_BLOCK B VAR_EXTERNAL n : INT; END_VAR n := n + top; END_FUNCTION_BLOCK
    PROGRAM p VAR b : B; a : ARRAY[0..top] OF INT; r, f : INT; END_VAR
    IF FIRST_SCAN() THEN f := f + 1; END_IF b(); r := n; END_PROGRAM"""
    one, other = program(text), program(text)
    for number in (1, 2):
        scan(one, number)
    scan(other)
    assert (one.st_body.v_r, one.st_body.v_f, len(one.st_body.v_a)) == (11, 1, 4)
    assert other.st_body.v_r == 8  # each program has separate globals


def test_inputs_keep_their_last_value_and_is_good_shows_it() -> None:
    made = program(
        "PROGRAM p VAR_INPUT x : REAL := 2.5; END_VAR VAR_OUTPUT y : REAL; g : BOOL; END_VAR y := x; g := IS_GOOD(x); END_PROGRAM"
    )
    quality = [Quality.BAD]
    made._lookup = lambda name: TagValue(1.0, quality[0], Reason.NONE, 0)
    scan(made)
    assert (made.y, made.g) == (2.5, False)  # type: ignore[attr-defined]
    made.x, quality[0] = 7.0, Quality.GOOD  # type: ignore[attr-defined]
    scan(made, 2)
    assert (made.y, made.g) == (7.0, True)  # type: ignore[attr-defined]


def test_an_input_that_does_not_fit_its_type_stops_the_program_with_the_reason() -> None:
    made = program("PROGRAM p VAR_INPUT n : INT; END_VAR VAR r : INT; END_VAR r := n; END_PROGRAM")
    made.n = 70_000  # type: ignore[attr-defined]
    with pytest.raises(Exception, match="-32768 to 32767"):
        scan(made)


def test_an_error_in_a_scan_names_the_line_of_the_source() -> None:
    made = program("PROGRAM p\nVAR a : ARRAY[1..3] OF INT; i : INT := 4; END_VAR\n  i := i;\n  a[i] := 1;\nEND_PROGRAM")
    with pytest.raises(Exception) as e:
        scan(made)
    error = failed(BoundProgram("main", made), e.value)
    assert isinstance(error, ProgramFailed)
    assert "test.st:4" in str(error)
    assert "an index outside its array" in str(error)


def test_retained_variables_survive_as_plain_data() -> None:
    text = """TYPE P : STRUCT x : INT; s : STRING; END_STRUCT; END_TYPE
    PROGRAM p VAR RETAIN n : INT; p1 : P; c : CTU; a : ARRAY[0..1] OF REAL; END_VAR VAR m : INT; END_VAR
    n := n + 1; m := m + 1; p1.x := n; p1.s := 'x'; a[1] := 2.5; c(CU := n MOD 2 = 1, PV := 9); END_PROGRAM"""
    one = program(text)
    for number in (1, 2, 3):
        scan(one, number)
    kept = json.loads(json.dumps(one.retained()))
    other = program(text)
    other.restore(kept)
    assert other.n == 3  # type: ignore[attr-defined]
    assert other.retained() == one.retained()
    scan(other, 1)
    assert (other.st_body.v_n, other.st_body.v_m, other.st_body.v_c.CV) == (4, 1, 2)
    with pytest.raises(FileInvalid, match="another form"):
        program(text).restore({"n": "text"})


@pytest.mark.parametrize("block", sorted(STANDARD_BLOCKS))
def test_every_block_can_be_retained(block: str) -> None:
    text = f"PROGRAM p VAR RETAIN b : {block}; END_VAR b(); END_PROGRAM"
    made, again = program(text), program(text)
    scan(made)
    kept = msgspec.msgpack.encode(made.retained())
    assert len(kept) <= made.retain_bytes()
    again.restore(msgspec.msgpack.decode(kept))
    assert again.retained() == made.retained()
    scan(again, 1, ms=1)


def test_an_alarm_outlives_a_restart_and_its_delay_starts_again() -> None:
    text = "PROGRAM p VAR RETAIN a : ALARM; END_VAR a(X := 5.0, H := 3.0, DELAY := T#30ms); END_PROGRAM"
    made, again = program(text), program(text)
    for number in range(1, 3):
        scan(made, number)
    again.restore(msgspec.msgpack.decode(msgspec.msgpack.encode(made.retained())))
    raised = []
    for number in range(1, 6):  # the new process's clock started again
        scan(again, number)
        raised.append(again.st_body.v_a.QH)
    assert raised == [False, False, False, True, True]


@pytest.mark.parametrize(
    ("text", "line", "told"),
    [
        ("PROGRAM p VAR a : INTT; END_VAR END_PROGRAM", 1, "did you mean 'INT'?"),
        ("PROGRAM p VAR a : INT; A : BOOL; END_VAR END_PROGRAM", 1, "declared twice"),
        (
            "FUNCTION f : INT VAR a AT %MW0 : INT; END_VAR f := 1; END_FUNCTION PROGRAM p END_PROGRAM",
            1,
            "an address in VAR of a FUNCTION; expected addresses in VAR, VAR_INPUT or VAR_OUTPUT of a PROGRAM or FUNCTION_BLOCK",
        ),
        ("PROGRAM p VAR_IN_OUT a AT %IX0.0 : BOOL; END_VAR END_PROGRAM", 1, "an address in VAR_IN_OUT of a PROGRAM"),
        ("PROGRAM p VAR n : INT; go AT %IX0.0 : BOOL; END_VAR\ngo := TRUE; END_PROGRAM", 2, "go cannot be assigned to"),
        ("PROGRAM p VAR CONSTANT c : INT := 1; END_VAR\nc := 2; END_PROGRAM", 2, "c cannot be assigned to"),
        ("PROGRAM p VAR_INPUT c : INT; END_VAR\nc := 2; END_PROGRAM", 2, "c cannot be assigned to"),
        ("PROGRAM p VAR t : TON; END_VAR\nt.Q := TRUE; END_PROGRAM", 2, "cannot be assigned to"),
        ("PROGRAM p VAR t : TON; END_VAR\nt(INN := TRUE); END_PROGRAM", 2, "did you mean 'IN'?"),
        ("PROGRAM p VAR t, u : TON; END_VAR\nt := u; END_PROGRAM", 2, "a TON cannot be assigned"),
        ("PROGRAM p VAR n : INT; END_VAR\nIF n THEN ; END_IF END_PROGRAM", 2, "expected BOOL; got INT"),
        ("PROGRAM p\nEXIT; END_PROGRAM", 2, "EXIT outside a loop"),
        ("PROGRAM p VAR n : INT; END_VAR CASE n OF\n1..3: ;\n2: ; END_CASE END_PROGRAM", 3, "another branch"),
        ("PROGRAM p VAR a : ARRAY[0..3] OF INT; END_VAR\na[4] := 1; END_PROGRAM", 2, "expected 0 to 3; got 4"),
        ("PROGRAM p VAR a : ARRAY[0..3] OF INT; END_VAR\na[1, 2] := 1; END_PROGRAM", 2, "indices; expected 1"),
        ("PROGRAM p VAR s : INT(0..5) := 9; END_VAR END_PROGRAM", 1, "an initial value"),
        ("PROGRAM p VAR_INPUT t : TON; END_VAR END_PROGRAM", 1, "cannot be bound to a tag"),
        ("TYPE A : STRUCT b : A; END_STRUCT; END_TYPE", 1, "contains itself"),
        ("FUNCTION f : INT\nf := g(); END_FUNCTION FUNCTION g : INT\ng := f(); END_FUNCTION", 3, "calls itself"),
        (
            "FUNCTION_BLOCK b VAR x : b; END_VAR END_FUNCTION_BLOCK PROGRAM p VAR y : b; END_VAR END_PROGRAM",
            1,
            "contains itself",
        ),
        ("PROGRAM p VAR a : ARRAY[0..9999, 0..9999] OF INT; END_VAR END_PROGRAM", 1, "too much data"),
        ("PROGRAM p VAR b : BYTE; x : BOOL; END_VAR\nx := b.8; END_PROGRAM", 2, "bits 0 to 7"),
        ("PROGRAM p\nVAR a : INT END_VAR END_PROGRAM", 2, "not Structured Text"),
        ("PROGRAM p\nIF TRUE THEN", 2, "the end of the file"),
    ],
)
def test_mistakes_are_refused_with_line_column_and_reason(text: str, line: int, told: str) -> None:
    with pytest.raises(FileInvalid) as e:
        program(text)
    assert told in str(e.value)
    assert e.value.line == line
    assert e.value.column >= 1


def test_a_variable_at_an_address_is_an_input_or_an_output() -> None:
    made = program(
        "PROGRAM p VAR go AT %IX0.0 : BOOL; n : INT; lamp AT %QX0.1 : BOOL; horn at %q* : BOOL; m AT %MW3 : INT := 4; END_VAR\n"
        "lamp := go; m := m + 1; n := m; END_PROGRAM"
    )
    assert [(v.name, v.role) for v in made.variables.values()] == [
        ("go", Role.INPUT), ("n", Role.LOCAL), ("lamp", Role.OUTPUT), ("horn", Role.OUTPUT), ("m", Role.LOCAL),
    ]  # fmt: skip
    made.go = True  # type: ignore[attr-defined]
    scan(made)
    assert (made.lamp, made.horn, made.m, made.n) == (True, False, 5, 5)  # type: ignore[attr-defined]


def test_a_file_with_its_configuration_as_openplc_writes_it() -> None:
    made = program(
        """PROGRAM blink
  VAR_EXTERNAL runs : DINT; END_VAR
  VAR lamp AT %QX0.0 : BOOL; on : INT; END_VAR
  lamp := NOT(lamp); on := on + LIMIT; runs := runs + 1;
END_PROGRAM

CONFIGURATION Config0
  VAR_GLOBAL runs : DINT; END_VAR
  RESOURCE Res0 ON PLC
    VAR_GLOBAL CONSTANT LIMIT : INT := 7; END_VAR
    TASK task0(INTERVAL := T#20ms,PRIORITY := 0);
    TASK edge(SINGLE := TRUE, PRIORITY := 1);
    PROGRAM instance0 WITH task0 : blink;
  END_RESOURCE
END_CONFIGURATION
"""
    )
    scan(made)
    assert (made.lamp, made.on) == (True, 7)  # type: ignore[attr-defined]


CONFIGURATION = """PROGRAM blink VAR x : INT; END_VAR x := 1; END_PROGRAM
CONFIGURATION Config0
  RESOURCE Res0 ON PLC
    TASK fast(INTERVAL := T#20ms, PRIORITY := 0);
    PROGRAM one WITH fast : blink;
  END_RESOURCE
END_CONFIGURATION
"""


@pytest.mark.parametrize(
    ("right", "wrong", "said"),
    [
        ("WITH fast : blink", "WITH fast : blank", "5:29: a program 'blank' is not declared; expected blink"),
        ("WITH fast : blink", "WITH slow : blink", "5:22: a task 'slow' is not declared"),
    ],
)
def test_an_unknown_name_in_a_configuration_is_refused(right: str, wrong: str, said: str) -> None:
    program(CONFIGURATION)
    with pytest.raises(FileInvalid, match=said):
        program(CONFIGURATION.replace(right, wrong))


@pytest.mark.parametrize(
    ("one", "other", "refused"),
    [
        ("%MW0", "%MW0", True),
        ("%QX0.1", "%Q0.01", True),
        ("%mw3", "%MW03", True),
        ("%MW0", "%MD0", False),  # tools differ in whether these share bits
        ("%QX0.1", "%QX0.2", False),
        ("%IX0.1", "%IX0.1", False),  # the system file binds both, to one tag or to two
    ],
)
def test_two_variables_with_one_address_are_refused(one: str, other: str, refused: bool) -> None:
    text = f"PROGRAM p VAR a AT {one} : BOOL;\n  b AT {other} : BOOL; END_VAR END_PROGRAM"
    if not refused:
        program(text)
        return
    with pytest.raises(FileInvalid, match="2:3: b and a have one address; expected one variable for each address"):
        program(text)


def test_which_program_is_meant() -> None:
    two = "PROGRAM a END_PROGRAM PROGRAM b VAR x : INT := 1; END_VAR END_PROGRAM"
    with pytest.raises(FileInvalid, match="which PROGRAM"):
        program(two)
    assert program(two, "B").variables.keys() == {"x"}
    with pytest.raises(FileInvalid, match="no PROGRAM c"):
        program(two, "c")


def test_a_function_without_a_result_is_called_as_a_statement() -> None:
    before = """FUNCTION note VAR_INPUT n : INT; END_VAR VAR_OUTPUT twice : INT; END_VAR VAR_IN_OUT total : INT; END_VAR
    IF n < 0 THEN RETURN; END_IF twice := 2 * n; total := total + n; END_FUNCTION
    FUNCTION nothing END_FUNCTION"""
    got = run("sum, two : INT;", "note(n := 4, total := sum, twice => two); note(-1, sum); nothing();", before)
    assert (got["sum"], got["two"]) == (4, 8)


@pytest.mark.parametrize(
    "use", ["x := nothing();", "x := 1 + nothing();", "IF nothing() THEN x := 1; END_IF", "x := ABS(nothing());"]
)
def test_a_function_without_a_result_has_no_value(use: str) -> None:
    with pytest.raises(FileInvalid, match=r"got .*no result"):
        run("x : INT;", use, "FUNCTION nothing END_FUNCTION")


def test_an_enumeration_may_state_the_type_of_its_values() -> None:
    for types in (
        "TYPE Light : USINT (red := 7, green) := green; END_TYPE",
        "TYPE Light : (red := 7, green) USINT := green; END_TYPE",
    ):
        got = run("l : Light; r : Light := red;", "", types)
        assert (got["l"], got["r"]) == (8, 7)
    for types, reason in (
        ("TYPE Light : USINT (red := 255, green); END_TYPE", "green is outside USINT; expected 0 to 255; got 256"),
        ("TYPE Light : REAL (red); END_TYPE", "the type of an enumeration's values"),
        ("TYPE Light : INT (red) INT; END_TYPE", "two types"),
    ):
        with pytest.raises(FileInvalid, match=reason):
            run("", "", types)


def test_0_and_1_are_literals_of_bool_in_conditions() -> None:
    """IEC 61131-3:2013, table 5, feature 7."""
    body = """IF 1 THEN n := 1; END_IF
      WHILE 1 DO n := n + 1; IF n = 3 THEN EXIT; END_IF; END_WHILE; WHILE 0 DO n := -1; END_WHILE
      REPEAT n := n + 1; UNTIL BOOL#1 END_REPEAT; REPEAT n := n + 1; UNTIL 1 END_REPEAT
      a := SEL(0, 10, 20); b := SEL(G := 1, IN0 := 10, IN1 := 20);"""
    found = run("n, a, b : INT;", body)
    assert (found["n"], found["a"], found["b"]) == (5, 10, 20)
    with pytest.raises(FileInvalid, match="the condition of IF; expected BOOL; got 2"):
        run("n : INT;", "IF 2 THEN n := 1; END_IF")
