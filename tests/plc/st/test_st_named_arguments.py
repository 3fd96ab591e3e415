"""Arguments of standard functions, functions and function blocks by their names (IEC 61131-3, 6.6.1.4 and 6.6.2.5).

Defect: the named arguments of standard functions were used by their position and their names were ignored, so that ``LIMIT(MX
:= 10, IN := 5, MN := 0)`` gave 0. Every function of the library needs a row in `SAMPLES`: its parameters as the standard names
them, and a result that was computed by hand.
"""

from __future__ import annotations

from itertools import permutations
from typing import Any

import pytest
from st_bench import program, run, value

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.plc.st.compiler.functions.memory import MEMORY
from fieldtwin.plc.st.compiler.functions.standard import FUNCTIONS
from fieldtwin.plc.st.types import ELEMENTARY

S = 1_000_000_000

Sample = tuple[str, list[tuple[str, str]], Any]
"""The type of the result, the parameters in the standard's order each with an argument, and the result."""

SAMPLES: dict[str, Sample] = {
    **{name: ("LREAL", [("IN", "1.0")], expected) for name, expected in (
        ("SQRT", 1.0), ("LN", 0.0), ("LOG", 0.0), ("EXP", 2.718281828459045), ("SIN", 0.8414709848078965),
        ("COS", 0.5403023058681398), ("TAN", 1.5574077246549023), ("ASIN", 1.5707963267948966), ("ACOS", 0.0),
        ("ATAN", 0.7853981633974483),
    )},
    "ABS": ("INT", [("IN", "-4")], 4),
    "ATAN2": ("LREAL", [("Y", "LREAL#1.0"), ("X", "LREAL#0.0")], 1.5707963267948966),
    "ADD": ("INT", [("IN1", "1"), ("IN2", "20"), ("IN3", "300")], 321),
    "MUL": ("INT", [("IN1", "2"), ("IN2", "3"), ("IN3", "4")], 24),
    "SUB": ("INT", [("IN1", "10"), ("IN2", "3")], 7),
    "DIV": ("INT", [("IN1", "9"), ("IN2", "2")], 4),
    "MOD": ("INT", [("IN1", "9"), ("IN2", "5")], 4),
    "EXPT": ("LREAL", [("IN1", "2.0"), ("IN2", "3.0")], 8.0),
    "MOVE": ("INT", [("IN", "7")], 7),
    "SHL": ("BYTE", [("IN", "BYTE#3"), ("N", "1")], 6),
    "SHR": ("BYTE", [("IN", "BYTE#16"), ("N", "2")], 4),
    "ROL": ("BYTE", [("IN", "BYTE#16#81"), ("N", "2")], 6),
    "ROR": ("BYTE", [("IN", "BYTE#3"), ("N", "1")], 0x81),
    "AND": ("WORD", [("IN1", "WORD#2#111"), ("IN2", "WORD#2#110"), ("IN3", "WORD#2#011")], 0b010),
    "OR": ("WORD", [("IN1", "WORD#1"), ("IN2", "WORD#2"), ("IN3", "WORD#8")], 11),
    "XOR": ("BOOL", [("IN1", "TRUE"), ("IN2", "TRUE"), ("IN3", "TRUE")], True),
    "SEL": ("INT", [("G", "TRUE"), ("IN0", "0"), ("IN1", "1")], 1),
    "MAX": ("INT", [("IN1", "3"), ("IN2", "9"), ("IN3", "5")], 9),
    "MIN": ("INT", [("IN1", "3"), ("IN2", "2"), ("IN3", "5")], 2),
    "LIMIT": ("INT", [("MN", "0"), ("IN", "5"), ("MX", "10")], 5),
    "MUX": ("INT", [("K", "1"), ("IN0", "10"), ("IN1", "20"), ("IN2", "30")], 20),
    "GT": ("BOOL", [("IN1", "3"), ("IN2", "2"), ("IN3", "1")], True),
    "GE": ("BOOL", [("IN1", "3"), ("IN2", "3"), ("IN3", "1")], True),
    "EQ": ("BOOL", [("IN1", "3"), ("IN2", "3"), ("IN3", "1")], False),
    "LE": ("BOOL", [("IN1", "1"), ("IN2", "3"), ("IN3", "3")], True),
    "LT": ("BOOL", [("IN1", "1"), ("IN2", "3"), ("IN3", "2")], False),
    "NE": ("BOOL", [("IN1", "1"), ("IN2", "3")], True),
    "LEN": ("INT", [("IN", "'abc'")], 3),
    "LEFT": ("STRING", [("IN", "'abcd'"), ("L", "3")], "abc"),
    "RIGHT": ("STRING", [("IN", "'abcd'"), ("L", "3")], "bcd"),
    "MID": ("STRING", [("IN", "'abcdef'"), ("L", "1"), ("P", "3")], "c"),
    "CONCAT": ("STRING", [("IN1", "'a'"), ("IN2", "'b'"), ("IN3", "'c'")], "abc"),
    "INSERT": ("STRING", [("IN1", "'abc'"), ("IN2", "'XY'"), ("P", "1")], "aXYbc"),
    "DELETE": ("STRING", [("IN", "'abcd'"), ("L", "1"), ("P", "2")], "acd"),
    "REPLACE": ("STRING", [("IN1", "'abcde'"), ("IN2", "'X'"), ("L", "2"), ("P", "3")], "abXe"),
    "FIND": ("INT", [("IN1", "'abcbc'"), ("IN2", "'bc'")], 2),
    "CHR": ("STRING", [("IN", "65")], "A"),
    "ASC": ("BYTE", [("IN", "'AB'"), ("P", "2")], 66),
    "FIRST_SCAN": ("BOOL", [], True),
    "SCAN_TIME": ("LTIME", [], 10_000_000),
    "ADD_TIME": ("TIME", [("IN1", "T#3s"), ("IN2", "T#1s")], 4 * S),
    "ADD_TOD_TIME": ("TOD", [("IN1", "TOD#00:00:03"), ("IN2", "T#1s")], 4 * S),
    "ADD_DT_TIME": ("DT", [("IN1", "DT#1970-01-01-00:00:03"), ("IN2", "T#1s")], 4 * S),
    "SUB_TIME": ("TIME", [("IN1", "T#3s"), ("IN2", "T#1s")], 2 * S),
    "SUB_DATE_DATE": ("TIME", [("IN1", "D#1970-01-03"), ("IN2", "D#1970-01-02")], 86_400 * S),
    "SUB_TOD_TIME": ("TOD", [("IN1", "TOD#00:00:03"), ("IN2", "T#1s")], 2 * S),
    "SUB_TOD_TOD": ("TIME", [("IN1", "TOD#00:00:03"), ("IN2", "TOD#00:00:01")], 2 * S),
    "SUB_DT_TIME": ("DT", [("IN1", "DT#1970-01-01-00:00:03"), ("IN2", "T#1s")], 2 * S),
    "SUB_DT_DT": ("TIME", [("IN1", "DT#1970-01-01-00:00:03"), ("IN2", "DT#1970-01-01-00:00:01")], 2 * S),
    "MUL_TIME": ("TIME", [("IN1", "T#3s"), ("IN2", "2")], 6 * S),
    "DIV_TIME": ("TIME", [("IN1", "T#3s"), ("IN2", "2")], 3 * S // 2),
    "CONCAT_DATE_TOD": ("DT", [("IN1", "D#1970-01-02"), ("IN2", "TOD#00:00:03")], 86_403 * S),
    "MULTIME": ("TIME", [("IN1", "T#3s"), ("IN2", "2")], 6 * S),
    "DIVTIME": ("TIME", [("IN1", "T#3s"), ("IN2", "2")], 3 * S // 2),
    "ADD_LTIME": ("LTIME", [("IN1", "LT#3s"), ("IN2", "LT#1s")], 4 * S),
    "ADD_LTOD_LTIME": ("LTOD", [("IN1", "LTOD#00:00:03"), ("IN2", "LT#1s")], 4 * S),
    "ADD_LDT_LTIME": ("LDT", [("IN1", "LDT#1970-01-01-00:00:03"), ("IN2", "LT#1s")], 4 * S),
    "SUB_LTIME": ("LTIME", [("IN1", "LT#3s"), ("IN2", "LT#1s")], 2 * S),
    "SUB_LDATE_LDATE": ("LTIME", [("IN1", "LDATE#1970-01-03"), ("IN2", "LDATE#1970-01-02")], 86_400 * S),
    "SUB_LTOD_LTIME": ("LTOD", [("IN1", "LTOD#00:00:03"), ("IN2", "LT#1s")], 2 * S),
    "SUB_LTOD_LTOD": ("LTIME", [("IN1", "LTOD#00:00:03"), ("IN2", "LTOD#00:00:01")], 2 * S),
    "SUB_LDT_LTIME": ("LDT", [("IN1", "LDT#1970-01-01-00:00:03"), ("IN2", "LT#1s")], 2 * S),
    "SUB_LDT_LDT": ("LTIME", [("IN1", "LDT#1970-01-01-00:00:03"), ("IN2", "LDT#1970-01-01-00:00:01")], 2 * S),
    "MUL_LTIME": ("LTIME", [("IN1", "LT#3s"), ("IN2", "2")], 6 * S),
    "DIV_LTIME": ("LTIME", [("IN1", "LT#3s"), ("IN2", "2")], 3 * S // 2),
    "CONCAT_DATE_LTOD": ("LDT", [("IN1", "D#1970-01-02"), ("IN2", "LTOD#00:00:03")], 86_403 * S),
    "CONCAT_DATE": ("DATE", [("YEAR", "1970"), ("MONTH", "1"), ("DAY", "3")], 2 * 86_400 * S),
    "CONCAT_TOD": ("TOD", [("HOUR", "0"), ("MINUTE", "1"), ("SECOND", "2"), ("MILLISECOND", "0")], 62 * S),
    "CONCAT_LTOD": ("LTOD", [("HOUR", "0"), ("MINUTE", "1"), ("SECOND", "2"), ("MILLISECOND", "0")], 62 * S),
    "DAY_OF_WEEK": ("INT", [("IN", "D#1970-01-01")], 4),
}  # fmt: skip
CONVERSIONS: dict[str, Sample] = {
    "INT_TO_REAL": ("REAL", [("IN", "3")], 3.0),
    "TO_INT": ("INT", [("IN", "2.5")], 2),
    "TRUNC": ("DINT", [("IN", "-2.9")], -2),
    "REAL_TRUNC_INT": ("INT", [("IN", "2.9")], 2),
    "STRING_TO_INT": ("INT", [("IN", "'7'")], 7),
    "WORD_BCD_TO_UINT": ("UINT", [("IN", "WORD#16#1234")], 1234),
    "UINT_TO_BCD_WORD": ("WORD", [("IN", "1234")], 0x1234),
    "BCD_TO_INT": ("INT", [("IN", "WORD#16#1234")], 1234),
    "INT_TO_BCD": ("WORD", [("IN", "1234")], 0x1234),
}
WITH_A_VARIABLE = {
    "MSG_COUNT": ["BOX"], "MSG_AT": ["BOX", "I"], "MSG_TIME": ["BOX", "I"], "MSG_ROOM": ["BOX"], "MSG_MAX": ["BOX"],
    "MSG_SEND": ["BOX", "TEXT", "T"], "IS_GOOD": ["IN"],
}  # fmt: skip
"""Functions of this PLC that refer to an input or a mailbox of the program."""
ELSEWHERE = {"CONCAT_DT", "CONCAT_LDT", "SPLIT_DATE", "SPLIT_TOD", "SPLIT_LTOD", "SPLIT_DT", "SPLIT_LDT",
             *MEMORY.names(), "REF", "ADR", "LOWER_BOUND", "UPPER_BOUND", "SIZEOF", "XSIZEOF", "__ISVALIDREF",
             "__QUERYINTERFACE", "NOT"}  # fmt: skip
"""Functions with outputs, or with seven parameters, which have too many orders, and functions of variables. They are in
test_st_dates_and_bcd.py, test_st_references.py, test_st_pointers.py, test_st_copied_memory.py and test_st_open_arrays.py."""
ALL = {**SAMPLES, **CONVERSIONS}


def call(name: str, arguments: list[tuple[str, str]]) -> str:
    return f"{name}({', '.join(f'{formal} := {given}' if formal else given for formal, given in arguments)})"


def test_every_function_of_the_library_has_a_sample_here() -> None:
    assert set(FUNCTIONS.names()) == SAMPLES.keys() | WITH_A_VARIABLE.keys() | ELSEWHERE
    for name, (_, arguments, _) in ALL.items():
        found = FUNCTIONS.find(name)
        assert found is not None
        assert found.formals.all_names(len(arguments)) == [formal for formal, _ in arguments], name


@pytest.mark.parametrize("name", sorted(ALL))
def test_named_arguments_mean_the_same_in_every_order(name: str) -> None:
    kind, arguments, expected = ALL[name]
    for order in permutations(arguments):
        got = value(kind, call(name, list(order)))
        assert got == expected, order
        assert type(got) is type(expected)
    assert value(kind, call(name, [(formal.lower(), given) for formal, given in arguments])) == expected


@pytest.mark.parametrize("name", sorted(ALL))
def test_positional_arguments_may_be_followed_by_named_ones(name: str) -> None:
    kind, arguments, expected = ALL[name]
    for count in range(len(arguments) + 1):
        first = [("", given) for _, given in arguments[:count]]
        for rest in permutations(arguments[count:]):
            assert value(kind, call(name, [*first, *rest])) == expected


@pytest.mark.parametrize("name", sorted(ALL))
def test_wrong_missing_and_repeated_names_are_refused(name: str) -> None:
    kind, arguments, _ = ALL[name]
    found = FUNCTIONS.find(name)
    assert found is not None
    refused = [([("WRONG", "1"), *arguments[1:]], f"in {name}, a parameter 'WRONG' is not declared")]
    for n, (formal, given) in enumerate(arguments):
        refused.append(([*arguments, (formal, given)], f"parameter {formal} of {name} is given twice"))
        refused.append(([("", given), *arguments], f"parameter {arguments[0][0]} of {name} is given twice"))
        may_be_left_out = n + 1 == len(arguments) and (found.formals.optional or (found.formals.repeats and n >= 2))
        if not may_be_left_out and name != "CONCAT":
            refused.append(([*arguments[:n], *arguments[n + 1 :]], f"arguments of {name}"))
    if len(arguments) > 1:
        late = [arguments[0], *(("", given) for _, given in arguments[1:])]
        refused.append((late, f"a positional argument of {name} after a named one"))
    for wrong, told in refused:
        with pytest.raises(FileInvalid) as e:
            value(kind, call(name, wrong))
        assert told in str(e.value), wrong
        assert e.value.line == 3


def test_a_gap_in_the_numbered_parameters_is_refused() -> None:
    for wrong in ("ADD(IN1 := 1, IN3 := 2)", "CONCAT(IN2 := 'a')", "MAX(IN1 := 1, IN2 := 2, IN999 := 3)"):
        with pytest.raises(FileInvalid, match=r"arguments of \w+; expected . or more \(IN1.*without IN"):
            value("INT", wrong)
    for wrong in ("ADD(IN1 := 1, IN0 := 2)", "ADD(IN1 := 1, IN02 := 2)", "ADD(IN1 := 1, IN9999 := 2)"):
        with pytest.raises(FileInvalid):
            value("INT", wrong)


def test_a_standard_function_has_no_outputs() -> None:
    with pytest.raises(FileInvalid, match="ADD has no output OUT"):
        run("x : INT; ok : BOOL;", "x := ADD(1, 2, OUT => ok);")


def test_the_names_of_this_plcs_own_functions() -> None:
    text = """PROGRAM p VAR_INPUT box : MESSAGES; x : INT; END_VAR VAR_OUTPUT out : MESSAGES[8, 4]; END_VAR
    VAR n : DINT; s : STRING; t : LTIME; b : BOOL; END_VAR
    n := MSG_COUNT(BOX := box); IF n > 0 THEN s := MSG_AT(I := 1, BOX := box); t := MSG_TIME(I := 1, BOX := box); END_IF
    n := MSG_ROOM(BOX := out) + MSG_MAX(BOX := out); b := MSG_SEND(T := LT#5ns, TEXT := 'hi', BOX := out) AND IS_GOOD(IN := x);
    END_PROGRAM"""
    assert program(text).st_body.v_n == 0
    for wrong in ("MSG_COUNT(IN := box)", "MSG_COUNT()", "MSG_COUNT(box, box)"):
        with pytest.raises(FileInvalid, match="MSG_COUNT"):
            program(text.replace("MSG_COUNT(BOX := box)", wrong))
    for name, formals in WITH_A_VARIABLE.items():
        found = FUNCTIONS.find(name)
        assert found is not None
        assert list(found.formals.names) == formals


def test_the_calls_that_were_seen_to_give_wrong_results() -> None:
    assert value("INT", "LIMIT(MX:=10, IN:=5, MN:=0)") == 5
    assert value("INT", "SUB(IN2:=3, IN1:=10)") == 7
    assert value("INT", "DIV(IN2:=2, IN1:=9)") == 4
    assert value("INT", "SEL(G:=TRUE, IN1:=1, IN0:=0)") == 1
    assert value("STRING", "DELETE(IN:='abcd', P:=2, L:=1)") == "acd"
    with pytest.raises(FileInvalid, match="'Q' is not declared"):
        value("INT", "LIMIT(Q:=1, R:=2, S:=3)")


FUNCTION = "FUNCTION f : INT VAR_INPUT a, b : INT; END_VAR f := 10 * a + b; END_FUNCTION "


def test_functions_and_blocks_of_the_program_bind_arguments_by_the_same_rules() -> None:
    assert run("r : INT;", "r := f(b := 2, a := 1);", FUNCTION)["r"] == 12
    assert run("r : INT;", "r := f(1, b := 2);", FUNCTION)["r"] == 12
    for wrong, told in (
        ("f(a := 1, 2)", "a positional argument of f after a named one"),
        ("f(1, a := 2)", "parameter a of f is given twice"),
        ("f(1, 2, 3)", "arguments of f; expected 2 (a, b); got 3"),
        ("f(c := 1)", "in f, a parameter 'c' is not declared"),
    ):
        with pytest.raises(FileInvalid) as e:
            run("r : INT;", f"r := {wrong};", FUNCTION)
        assert told in str(e.value)
    for wrong, told in (
        ("t(IN := TRUE, T#1s)", "a positional argument of TON after a named one"),
        ("t(TRUE, IN := FALSE)", "parameter IN of TON is given twice"),
        ("t(IN := TRUE, IN := FALSE)", "parameter IN of TON is given twice"),
        ("t(TRUE, T#1s, 1)", "an output of TON needs a variable"),
        ("t(TRUE, T#1s, q, d, q)", "arguments of TON; expected 4 (IN, PT, Q, ET); got 5"),
        ("t(TRUE, T#1s, q, Q => q)", "parameter Q of TON is given twice"),
        ("t(IN := TRUE, Q := q)", "in TON, a parameter 'Q' is not declared"),
    ):
        with pytest.raises(FileInvalid) as e:
            run("t : TON; q : BOOL; d : TIME;", f"{wrong};")
        assert told in str(e.value)


MIXED = """TYPE Made : STRUCT a, b : INT; END_STRUCT END_TYPE
FUNCTION change : INT
VAR_IN_OUT total : INT; END_VAR VAR_OUTPUT half : INT; END_VAR VAR_INPUT by : INT; END_VAR VAR_OUTPUT made : Made; END_VAR
  total := total + by; half := total / 2; made.b := total; change := by;
END_FUNCTION
FUNCTION_BLOCK Count VAR_IN_OUT total : INT; END_VAR VAR_INPUT by : INT; END_VAR VAR_OUTPUT odd : BOOL; END_VAR
  total := total + by; odd := total MOD 2 = 1;
  METHOD PUBLIC change VAR_OUTPUT last : INT; END_VAR VAR_INPUT by : INT; END_VAR last := by; END_METHOD
END_FUNCTION_BLOCK
FUNCTION_BLOCK Wide EXTENDS Count VAR_INPUT more : INT; END_VAR total := total + by + more; END_FUNCTION_BLOCK
"""


def test_positional_arguments_take_all_parameters_in_the_order_of_their_declarations() -> None:
    """Defect: inputs were taken before VAR_IN_OUT, whatever the declaration said, and outputs could be given by name only."""
    variables = "c : Count; w : Wide; n : INT := 2; h, last, r : INT; m : Made; bits : BYTE; t : TON; d : TIME;"
    body = """r := change(n, h, 5, m); c(n, 4, bits.%X3); c.change(last, 7); w(n, 10, bits.%X0, 100);
    t(TRUE, T#1s, bits.%X1, d);"""
    made = run(variables, body, MIXED)
    assert (made["r"], made["h"], made["n"], made["m"].m_b, made["last"], made["bits"]) == (5, 3, 121, 7, 7, 0b1000)
    with pytest.raises(FileInvalid, match="an output of change needs a variable"):
        run(variables, "r := change(n, 1, 5);", MIXED)


def test_every_elementary_type_converts_by_name() -> None:
    for source in ("INT", "REAL", "TIME"):
        for target in ELEMENTARY:
            found = FUNCTIONS.find(f"{source}_TO_{target}")
            assert found is not None
            assert found.formals.names == ("IN",)


def test_operators_are_functions_too() -> None:
    assert value("INT", "MOD(9, 5) + 9 MOD 5") == 8
    assert value("BOOL", "AND(TRUE, OR(FALSE, TRUE), XOR(TRUE, FALSE)) AND NOT (FALSE)") is True
    with pytest.raises(FileInvalid, match="is not declared"):
        value("BOOL", "AND_THEN(TRUE, TRUE)")


def test_not_is_an_operator_and_a_function() -> None:
    body = """b := NOT(IN := a); x := NOT(in := n = 1) AND NOT(n = 1); c := NOT(EN := x AND 0, IN := a, ENO => ok);
              y := NOT(x); d := NOT (a) AND 16#FF;"""
    found = run("a : WORD := 16#F0F0; b, c, d : WORD; n : INT; x, y, ok : BOOL;", body)
    assert [found[name] for name in ("b", "c", "d", "x", "y", "ok")] == [0x0F0F, 0, 0x0F, True, False, False]
    with pytest.raises(FileInvalid, match="in NOT, a parameter 'WRONG' is not declared"):
        run("x : BOOL;", "x := NOT(WRONG := x);")


ORDER = "VAR_IN_OUT sum : INT; END_VAR VAR_INPUT add : INT; END_VAR VAR_IN_OUT last : INT; END_VAR"


@pytest.mark.parametrize(
    ("before", "call"),
    [
        (f"FUNCTION f : INT {ORDER} sum := sum + add; last := add; END_FUNCTION", "n := f(x, y, z)"),
        (f"FUNCTION_BLOCK f {ORDER} sum := sum + add; last := add; END_FUNCTION_BLOCK", "b(x, y, z)"),
        (
            f"FUNCTION_BLOCK f METHOD PUBLIC m : INT {ORDER} sum := sum + add; last := add; END_METHOD END_FUNCTION_BLOCK",
            "n := b.m(x, y, z)",
        ),
        (
            f"FUNCTION_BLOCK base VAR_INPUT first : INT; END_VAR END_FUNCTION_BLOCK"
            f" FUNCTION_BLOCK f EXTENDS base {ORDER} sum := sum + add; last := add; END_FUNCTION_BLOCK",
            "b(9, x, y, z)",
        ),
    ],
)
def test_positional_arguments_have_the_order_of_the_declaration(before: str, call: str) -> None:
    """Defect: VAR_IN_OUT came after all VAR_INPUT, so that two parameters of one type were exchanged."""
    block = "b : f;" if "_BLOCK f" in before else ""
    found = run(f"{block} x : INT := 1; y : INT := 20; z, n : INT;", f"{call};", before)
    assert (found["x"], found["y"], found["z"]) == (21, 20, 20)
