"""POINTER TO, ADR, REFERENCE TO, REF= and SIZEOF of the dialects of CODESYS, and the bounds of pointers.

The standard has no pointers. The meaning is that of the CODESYS manual: ADR gives the address of a variable, addresses count
bytes, and a REFERENCE TO stands for its variable. An access outside the variable, which is undefined there, stops the task here.
"""

from __future__ import annotations

from typing import Any

import pytest
from st_bench import program
from st_bench import run as run_in

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.plc.st.values import LogicError


def run(variables: str, body: str, before: str = "", dialect: str = "codesys") -> dict[str, Any]:
    return run_in(variables, body, before, dialect=dialect)


@pytest.mark.parametrize("dialect", ["codesys", "twincat"])
def test_a_pointer_reads_and_writes_its_variable(dialect: str) -> None:
    found = run("x : INT := 3; y : INT; p : POINTER TO INT;", "p := ADR(x); y := p^; p^ := 8;", dialect=dialect)
    assert (found["x"], found["y"]) == (8, 3)


def test_a_pointer_walks_through_an_array() -> None:
    found = run(
        "a : ARRAY[5..8] OF DINT := [1, 20, 300, 4000]; p : POINTER TO DINT; i : INT; sum, last, middle : DINT;",
        """p := ADR(a); FOR i := 1 TO 4 DO sum := sum + p^; p := p + SIZEOF(DINT); END_FOR
        p := p - 4; last := p^; p := ADR(a[6]); p := p + 4; middle := p^; p[-2] := 7;""",
    )
    assert (found["sum"], found["last"], found["middle"], found["a"]) == (4321, 4000, 300, [7, 20, 300, 4000])


@pytest.mark.parametrize(
    "body",
    [
        "p := ADR(a) + 8; x := p^;",
        "p := ADR(a[0]) - 2; p^ := 1;",
        "p := ADR(a); x := p[4];",
        "p := ADR(x); p := p + 2; p^ := 1;",
        "q := ADR(a); x := q^[4];",
        "q := ADR(a); q^[i] := 1;",
        "r := ADR(a); x := r^[0];",
        "p := ADR(a) + 1;",
        "p := 0; p^ := 1;",
        "p := p + 2;",
        "q := ADR(a); w := q^;",
    ],
)
def test_a_pointer_outside_its_variable_stops_the_task(body: str) -> None:
    variables = """a : ARRAY[0..3] OF INT; i : INT := -1; x : INT; p : POINTER TO INT; q : POINTER TO ARRAY[0..100] OF INT;
    r : POINTER TO ARRAY[1..2] OF INT; w : ARRAY[0..100] OF INT;"""
    with pytest.raises(LogicError, match=r"pointer|NULL"):
        run(variables, body)


def test_a_moved_pointer_that_is_not_used_is_no_error() -> None:
    found = run("x : INT := 5; y : INT; p : POINTER TO INT;", "p := ADR(x) + SIZEOF(x); p := p - SIZEOF(x); y := p^;")
    assert found["y"] == 5


def test_a_function_takes_arrays_of_any_size_by_a_pointer() -> None:
    before = """FUNCTION mean : REAL
    VAR_INPUT pt : POINTER TO ARRAY[0..32000] OF REAL; size : UINT; END_VAR VAR i : UINT; END_VAR
    FOR i := 0 TO size / SIZEOF(pt^[0]) - 1 DO mean := mean + pt^[i]; END_FOR
    mean := mean / (size / SIZEOF(pt^[0]));
    END_FUNCTION"""
    found = run(
        "a : ARRAY[1..4] OF REAL := [1.0, 2.0, 3.0, 6.0]; b : ARRAY[0..0] OF REAL := [9.0]; m, n : REAL;",
        "m := mean(ADR(a), SIZEOF(a)); n := mean(pt := ADR(b), size := SIZEOF(b));",
        before,
    )
    assert (found["m"], found["n"]) == (3.0, 9.0)


def test_a_pointer_to_a_structure_in_an_array() -> None:
    before = "TYPE Point : STRUCT x : INT; y : DINT; END_STRUCT END_TYPE"
    found = run(
        "a : ARRAY[0..1] OF Point; p : POINTER TO Point; q : POINTER TO DINT;",
        "p := ADR(a[0]); p^.x := 1; p := p + SIZEOF(Point); p^.x := 2; q := ADR(p^.y); q^ := 3;",
        before,
    )
    assert [(point.m_x, point.m_y) for point in found["a"]] == [(1, 0), (2, 3)]


def test_the_bytes_of_a_string() -> None:
    found = run(
        "s : STRING[6] := 'pump'; p : POINTER TO BYTE; q : POINTER TO ARRAY[1..250] OF BYTE; n : INT; e : BYTE := 1;",
        """p := ADR(s); WHILE p^ <> 0 DO p^ := p^ - 32; p := p + 1; n := n + 1; END_WHILE
        q := ADR(s); e := q^[6]; q^[5] := 33; q^[6] := 33; q^[2] := 111;""",
    )
    assert (found["s"], found["n"], found["e"]) == ("PoMP!!", 4, 0)


def test_a_zero_ends_a_string() -> None:
    assert run("s : STRING := 'abcdef'; p : POINTER TO BYTE;", "p := ADR(s); p[3] := 0;")["s"] == "abc"


@pytest.mark.parametrize(("at", "length"), [(6, 20), (4, 4), (5, 4), (-1, 20)])
def test_a_byte_after_the_end_of_a_string_stops_the_task(at: int, length: int) -> None:
    with pytest.raises(LogicError):
        run(f"s : STRING[{length}] := 'abcd'; p : POINTER TO BYTE;", f"p := ADR(s); p := p + {at}; p^ := 65;")


def test_a_pointer_to_a_longer_or_shorter_string_cuts() -> None:
    found = run(
        "s : STRING[3] := 'abc'; t : STRING[9] := 'abcdefghi'; l : POINTER TO STRING[9]; k : POINTER TO STRING[3];"
        "a, b : STRING;",
        "l := ADR(s); a := l^; l^ := 'vwxyz'; k := ADR(t); b := k^; k^ := '123';",
    )
    assert (found["a"], found["s"], found["b"], found["t"]) == ("abc", "vwx", "abc", "123")


def test_a_pointer_to_a_variable_of_a_function() -> None:
    before = """FUNCTION f : INT VAR_INPUT a : INT; END_VAR VAR_OUTPUT o : INT; END_VAR
    VAR x : INT := 4; p : POINTER TO INT; END_VAR
    p := ADR(x); p^ := p^ + a; p := ADR(a); p^ := 30; p := ADR(o); p^ := 5; f := x + a; END_FUNCTION"""
    found = run("y, z : INT;", "y := f(2, o => z);", before)
    assert (found["y"], found["z"]) == (36, 5)


def test_a_pointer_to_a_block_calls_it() -> None:
    found = run("t : TON; p : POINTER TO TON; q : BOOL;", "p := ADR(t); p^(IN := TRUE, PT := T#0s); q := p^.Q;")
    assert found["q"] is True


def test_a_pointer_that_is_null_is_equal_to_0() -> None:
    found = run(
        "x : INT; p, q : POINTER TO INT; b : ARRAY[0..4] OF BOOL;",
        "b[0] := p = 0; p := ADR(x); b[1] := p <> 0; b[2] := p = ADR(x); q := p + 2; b[3] := p = q; p := NULL; b[4] := p = 0;",
    )
    assert found["b"] == [True, True, True, False, True]


def test_a_reference_stands_for_its_variable() -> None:
    found = run(
        "x : INT := 3; y : INT; r, s : REFERENCE TO INT; a, b : BOOL;",
        "a := __ISVALIDREF(r); r REF= x; b := __ISVALIDREF(r); y := r + 1; r := 7; s REF= r; s := s + 1; r REF= y; r := r * 10;",
    )
    assert (found["x"], found["y"], found["a"], found["b"]) == (8, 40, False, True)


def test_a_reference_as_an_input() -> None:
    before = """TYPE Point : STRUCT x : INT; END_STRUCT END_TYPE
    FUNCTION_BLOCK fb VAR_INPUT at : REFERENCE TO Point; END_VAR at.x := at.x + 1; END_FUNCTION_BLOCK
    FUNCTION f : INT VAR_INPUT n : REFERENCE TO INT; END_VAR n := n + 10; f := n; END_FUNCTION"""
    found = run(
        "p : Point; a : ARRAY[0..1] OF Point; i : fb; k, x : INT;",
        "i(at := p); i(at := a[1]); i(); x := f(k); x := x + f(n := k);",
        before,
    )
    assert (found["p"].m_x, found["a"][1].m_x, found["k"], found["x"]) == (1, 2, 20, 30)


def test_a_reference_to_no_variable_stops_the_task() -> None:
    with pytest.raises(LogicError, match="NULL"):
        run("r : REFERENCE TO INT;", "r := 1;")
    with pytest.raises(LogicError, match="NULL"):
        run("x : INT; r : REFERENCE TO INT;", "r REF= x; r REF= 0; x := r;")


def test_initial_values_of_pointers_and_references() -> None:
    found = run(
        "r : REFERENCE TO INT := x; p : POINTER TO INT := ADR(a[1]); x : INT; a : ARRAY[0..1] OF INT;",
        "r := 3; p^ := 4;",
    )
    assert (found["x"], found["a"]) == (3, [0, 4])


@pytest.mark.parametrize(
    ("what", "size"),
    [
        ("BOOL", 1), ("x", 2), ("DWORD", 4), ("LREAL", 8), ("TIME", 4), ("LTIME", 8), ("s", 81), ("w", 22), ("a", 24),
        ("a[1]", 4), ("Padded", 16), ("pad.c", 1), ("Mode", 2),
    ],
)  # fmt: skip
def test_sizes_are_those_of_codesys(what: str, size: int) -> None:
    """A member begins at a multiple of its size, and a structure ends at a multiple of its largest member."""
    before = "TYPE Padded : STRUCT a : BYTE; b : DWORD; l : LWORD := 0; END_STRUCT Mode : (on, off); END_TYPE"
    before = before.replace("l : LWORD := 0", "c : BYTE; d : WORD; e : BYTE")
    found = run(
        "x : INT; s : STRING; w : WSTRING[10]; a : ARRAY[0..1, 0..2] OF REAL; pad : Padded; n : UINT;",
        f"n := SIZEOF({what});",
        before,
    )
    assert found["n"] == size


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ("d := ADR(x);", "an address is not a number"),
        ("p := 16#1000;", "POINTER TO INT"),
        ("b := ADR(point);", "the memory of a Point as a BYTE is not supported"),
        ("f := p;", "the memory of a INT as a TON is not supported"),
        ("p := ADR(d.3);", "needs a variable"),
        ("p := ADR(5);", "needs a variable"),
        ("x := p - p;", "operands of -"),
        ("p := p * 2;", "operands of \\*"),
        ("f := f + 4;", "the size of a TON depends on the controller"),
        ("x := SIZEOF(t);", "the size of a TON depends on the controller"),
        ("x := SIZEOF(p);", "the size of a POINTER TO INT depends on the controller"),
        ("x := SIZEOF(nothing);", "nothing"),
        ("r REF= y;", "the memory of a REAL as a INT is not supported"),
        ("r REF= 5;", "REFERENCE TO INT"),
        ("p REF= x;", "left side of REF="),
        ("q := q; x := q[1];", "write \\^ before the index"),
        ("b := BITADR(x);", "memory of a controller"),
    ],
)
def test_what_would_need_the_memory_of_a_controller_is_refused(body: str, message: str) -> None:
    text = f"""TYPE Point : STRUCT x : INT; END_STRUCT END_TYPE
    PROGRAM p VAR x : INT; y : REAL; d : DWORD; t : TON; point : Point; p : POINTER TO INT; b : POINTER TO BYTE;
    f : POINTER TO TON; q : POINTER TO ARRAY[0..1] OF INT; r : REFERENCE TO INT; END_VAR {body} END_PROGRAM"""
    with pytest.raises(FileInvalid, match=message):
        program(text, dialect="codesys")


def test_a_program_may_still_have_variables_with_these_names() -> None:
    assert run("pointer, reference, ref : INT := 2; n : INT;", "n := pointer + reference + ref;")["n"] == 6


REFERRED = """VAR_GLOBAL cells : ARRAY[1..3] OF INT := [1, 2, 3]; END_VAR
FUNCTION cell : REFERENCE TO INT VAR_INPUT n : INT; END_VAR cell REF= cells[n]; END_FUNCTION
FUNCTION raised : INT VAR_INPUT r : REFERENCE TO INT; END_VAR r := r + 10; raised := r; END_FUNCTION
FUNCTION none : REFERENCE TO INT END_FUNCTION
FUNCTION_BLOCK Box VAR inner : INT := 5; END_VAR
METHOD PUBLIC fetch : REFERENCE TO INT fetch REF= inner; END_METHOD END_FUNCTION_BLOCK
"""


def test_the_result_of_a_function_may_be_a_reference_which_stands_for_its_variable() -> None:
    """Defect: such a result was neither a value nor accepted by REF= and by an input that is a REFERENCE TO."""
    body = """r REF= cell(2); r := 7; q REF= b.fetch(); q := 6; m := raised(cell(1)); n := cell(2) + b.fetch();
    k := cells[1];"""
    found = run("r, q : REFERENCE TO INT; b : Box; m, n, k : INT;", body, REFERRED)
    assert (found["m"], found["n"], found["k"]) == (11, 13, 11)
    with pytest.raises(LogicError, match="NULL"):
        run("n : INT;", "n := none();", REFERRED)
