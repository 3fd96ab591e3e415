"""Structured Text in edge cases: copies and references, order and scope, names, conversions, strings, times."""

from __future__ import annotations

import pytest
from st_bench import program, run, scan, value

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.plc.st.values import LogicError

POINT = "TYPE Point : STRUCT x : INT; a : ARRAY[1..2] OF INT; END_STRUCT; END_TYPE\n"


# -- functions, blocks, and what is handed to them --------------------------------------------------------------------


def test_a_whole_array_or_structure_assigned_through_an_in_out_reaches_the_caller() -> None:
    before = (
        POINT
        + """
    FUNCTION swap : INT VAR_IN_OUT p, q : Point; a : ARRAY[1..2] OF INT; END_VAR VAR t : Point; END_VAR
      t := p; p := q; q := t; a := p.a; a[2] := 99; swap := p.x; END_FUNCTION
    FUNCTION_BLOCK Clear VAR_IN_OUT a : ARRAY[1..2] OF INT; END_VAR VAR zero : ARRAY[1..2] OF INT; END_VAR
      a := zero; END_FUNCTION_BLOCK"""
    )
    body = (
        """p.x := 1; p.a[1] := 11; q.x := 2; q.a[1] := 22; r := swap(p := p, q := q, a := b); c[1] := 5; clr(a := c);"""
    )
    got = run("p, q : Point; b, c : ARRAY[1..2] OF INT; clr : Clear; r : INT;", body, before)
    assert (got["r"], got["p"].m_x, got["q"].m_x) == (2, 2, 1)
    assert (got["p"].m_a, got["q"].m_a) == ([22, 0], [11, 0])
    assert (got["b"], got["c"]) == ([22, 99], [0, 0])  # b is a copy of p.a: 99 remains in b


def test_the_same_variable_as_two_in_outs() -> None:
    before = "FUNCTION f : INT VAR_IN_OUT a, b : ARRAY[1..2] OF INT; END_VAR a[1] := 1; b[1] := b[1] + 1; f := a[1]; END_FUNCTION"
    assert run("x : ARRAY[1..2] OF INT; r : INT;", "r := f(a := x, b := x);", before)["r"] == 2


def test_an_input_of_a_function_is_a_copy() -> None:
    before = (
        POINT
        + """FUNCTION f : Point VAR_INPUT p : Point; END_VAR VAR l : Point; END_VAR l := p; l.a[1] := 7; f := l; END_FUNCTION"""
    )
    got = run("p, q : Point;", "p.a[1] := 1; q := f(p); q.a[2] := 9;", before)
    assert (got["p"].m_a, got["q"].m_a) == ([1, 0], [7, 9])


CALLS = """FUNCTION f : BOOL VAR_INPUT x : BOOL; END_VAR VAR_IN_OUT n : INT; END_VAR VAR_OUTPUT o : INT; END_VAR
 n := n + 1; o := 10 * n; f := x; END_FUNCTION\n"""


@pytest.mark.parametrize(
    ("condition", "result", "calls"),
    [
        ("FALSE AND_THEN f(TRUE, n := n)", False, 0),
        ("TRUE AND_THEN f(TRUE, n := n, o => o)", True, 1),
        ("TRUE OR_ELSE f(TRUE, n := n)", True, 0),
        ("FALSE OR_ELSE f(FALSE, n := n) OR_ELSE f(TRUE, n := n) OR_ELSE f(TRUE, n := n)", True, 2),
        ("FALSE AND f(TRUE, n := n)", False, 1),
        ("f(FALSE, n := n) AND_THEN f(TRUE, n := n)", False, 1),
    ],
)
def test_operands_skipped_by_and_then_and_or_else_are_not_evaluated(condition: str, result: bool, calls: int) -> None:
    got = run("r : BOOL; n, o : INT;", f"r := {condition};", CALLS)
    assert (got["r"], got["n"]) == (result, calls)


def test_calls_with_outputs_in_conditions_are_made_at_each_evaluation() -> None:
    body = """WHILE f(n < 3, n := n, o => o) DO s := s + o; END_WHILE;
              IF f(FALSE, n := m) THEN ; ELSIF f(TRUE, n := m) THEN e := m; ELSIF f(TRUE, n := m) THEN e := -1; END_IF;
              REPEAT k := k + 1; IF k < 3 THEN CONTINUE; END_IF; UNTIL f(k >= 3, n := c) END_REPEAT"""
    got = run("n, m, o, s, e, k, c : INT;", body, CALLS)
    assert (got["n"], got["s"], got["m"], got["e"], got["k"], got["c"]) == (4, 60, 2, 2, 3, 3)


def test_exit_and_return_leave_loops() -> None:
    before = """FUNCTION first : INT VAR_INPUT m : INT; END_VAR VAR i, j : INT; END_VAR
      FOR i := 1 TO 9 DO FOR j := 1 TO 9 DO IF i * j = m THEN first := 10 * i + j; RETURN; END_IF;
        IF j > i THEN EXIT; END_IF; END_FOR; END_FOR; first := -1; END_FUNCTION"""
    assert run("r, q : INT;", "r := first(12); q := first(11);", before) | {"t": 0} == {"r": 34, "q": -1, "t": 0}
    body = """FOR i := 1 TO 3 DO j := 0;
                REPEAT j := j + 1; IF j = 2 THEN CONTINUE; END_IF; s := s + j; UNTIL j >= 3 END_REPEAT; END_FOR"""
    assert run("i, j, s : INT;", body)["s"] == 3 * (1 + 3)
    body = "REPEAT i := i + 1; IF i = 3 THEN CONTINUE; END_IF; s := s + i; UNTIL i >= 3 END_REPEAT"
    assert run("i, s : INT;", body)["i"] == 3  # CONTINUE goes to the condition, not past it


def test_a_subrange_holds_only_values_inside_it() -> None:
    assert run("level : INT(0..100); i : INT := 100;", "level := i;")["level"] == 100
    for i in (101, -1):
        with pytest.raises(LogicError, match="0 to 100"):
            run(f"level : INT(0..100); i : INT := {i};", "level := i;")


def test_names_of_python_and_of_this_compiler_are_names_like_others() -> None:
    names = (
        "class, None_, self, len, int_, _v, _c, _1, _new1, pass, lambda, import_, unit, body, context, value, range_"
    )
    body = "; ".join(f"{n.strip()} := {k}" for k, n in enumerate(names.split(","), 1)) + ";"
    got = run(f"{names} : INT; t : TIME; v_t : INT;", body + " IF class = 1 THEN V_T := LEN('abc'); END_IF")
    assert got["v_t"] == 3
    assert [got[n.strip().lower()] for n in names.split(",")] == list(range(1, 18))


def test_case_never_matters() -> None:
    text = """Program P Var_Output OUT : int; End_Var var Arr : array[1..2] of Point; T1 : ton; e : LIGHT; end_var
    ARR[1].X := 3; t1(in := True, PT := t#0S); if T1.q And not FALSE then out := arr[1].x + dint_to_int(Twice(N := 2)); end_if;
    case E of RED: e := light#Green; end_case; end_program
    type POINT : struct x : INT; end_struct; Light : (red, GREEN); end_type
    function TWICE : DINT var_input n : dint; end_var twice := N * 2; END_function"""
    made = program(text)
    scan(made)
    assert (made.st_body.v_out, made.st_body.v_e) == (7, 1)
    assert list(made.variables) == ["OUT", "e"]  # tags keep the capitals of the declaration


def test_constants_may_size_arrays_and_be_initial_values() -> None:
    text = """VAR_GLOBAL CONSTANT rows : INT := 2; END_VAR
    TYPE Table : ARRAY[1..rows, 0..rows] OF INT; END_TYPE
    FUNCTION_BLOCK F VAR CONSTANT n : INT := 3; END_VAR VAR_OUTPUT q : INT; END_VAR VAR a : ARRAY[1..n] OF INT := [n(4)]; END_VAR
      q := a[n]; END_FUNCTION_BLOCK
    PROGRAM p VAR CONSTANT n : INT := 2 * 2; top : INT := n + 1; END_VAR
    VAR a : ARRAY[0..top] OF INT; t : Table; x : INT := top; f1 : F; END_VAR a[n] := 7; f1(); t[rows, 2] := 3; END_PROGRAM"""
    with pytest.raises(FileInvalid):  # the repetition count of a value is a number
        program(text)
    made = program(text.replace("n(4)", "3(4)"))
    scan(made)
    body = made.st_body
    assert (body.v_a, body.v_x, body.v_f1.v_q, body.v_t) == ([0, 0, 0, 0, 7, 0], 5, 4, [[0, 0, 0], [0, 0, 3]])


def test_globals_may_be_blocks_and_structures() -> None:
    text = (
        """VAR_GLOBAL t : TON; own : F; p : ARRAY[1..2] OF Point; END_VAR
    PROGRAM p VAR_OUTPUT q : INT; END_VAR own(); own(); p[2].x := own.n; q := p[2].x; END_PROGRAM
    FUNCTION_BLOCK F VAR_OUTPUT n : INT; END_VAR n := n + 1; END_FUNCTION_BLOCK
    """
        + POINT
    )
    made = program(text.replace("PROGRAM p ", "PROGRAM pr "))
    scan(made)
    assert made.st_body.v_q == 2


def test_comments_nest_and_hide_whatever_is_in_them() -> None:
    body = """n := 1; (* a (* b ' *) "c *) // ' (*
    n := n + 1; /* (* /* deep */ */ {pragma ' } s := 'a(*b*)$'//'; CASE n (* x *) OF 2 (* : *) (* , *), 3: n := 7; END_CASE"""
    got = run("n : INT; s : STRING;", body)
    assert (got["n"], got["s"]) == (7, "a(*b*)'//")


@pytest.mark.parametrize(
    ("text", "line", "column", "told"),
    [
        ("PROGRAM p\n  (* never", 2, 3, "a comment that does not end"),
        ("PROGRAM p VAR i : INT; END_VAR\nCASE i OF REAL#1.5: i := 1; END_CASE END_PROGRAM", 2, 11, "a label of CASE"),
        ("PROGRAM p VAR i : INT; END_VAR\n  CASE i OF 1..5: ; 9, 3: ; END_CASE END_PROGRAM", 2, 24, "another branch also has"),
        ("TYPE A : (x); B : (y); END_TYPE PROGRAM p VAR a : A; END_VAR\nCASE a OF y: ; END_CASE END_PROGRAM",
         2, 11, "a label of CASE"),
        ("PROGRAM p VAR s : STRING; END_VAR\ns := T#1s * s; END_PROGRAM", 2, 11, "operands of *"),
        ("FUNCTION f : INT\nVAR RETAIN x : INT; END_VAR END_FUNCTION", 2, 1, "RETAIN"),
        ("FUNCTION f : INT VAR f : INT; END_VAR f := 1; END_FUNCTION", 1, 10, "name of the function's result"),
        ("PROGRAM p VAR a : INT; b : INT := a; END_VAR END_PROGRAM", 1, 35, "'a' is not declared"),
        ("VAR_GLOBAL a : INT; b : INT := a; END_VAR", 1, 32, "not a constant"),
        ("PROGRAM p VAR CONSTANT n : INT := 0; END_VAR VAR a : ARRAY[0..1 / n] OF INT; END_VAR END_PROGRAM",
         1, 65, "division by zero"),
        ("PROGRAM p VAR variables : INT; END_VAR END_PROGRAM", 1, 15, "another name"),
        ("PROGRAM p VAR i : INT; END_VAR\ni := 1e; END_PROGRAM", 2, 7, "not Structured Text"),
    ],
)  # fmt: skip
def test_refused_at_their_position(text: str, line: int, column: int, told: str) -> None:
    with pytest.raises(FileInvalid, match=told) as e:
        program(text)
    assert (e.value.line, e.value.column) == (line, column)


# -- values: IEC 61131-3, tables 22 to 36 -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "expression", "expected"),
    [
        # rounding: to the nearest, ties to the even one (IEC 60559), also below zero
        ("INT", "REAL_TO_INT(0.5)", 0), ("INT", "REAL_TO_INT(1.5)", 2), ("INT", "REAL_TO_INT(2.5)", 2),
        ("INT", "REAL_TO_INT(-0.5)", 0), ("INT", "REAL_TO_INT(-1.5)", -2), ("INT", "REAL_TO_INT(-2.6)", -3),
        ("DINT", "TRUNC(2.9)", 2), ("DINT", "TRUNC(-2.9)", -2), ("SINT", "REAL_TRUNC_SINT(-127.9)", -127),
        ("LINT", "LREAL_TO_LINT(4503599627370497.0)", 4503599627370497),
        # integers keep the bits that fit
        ("SINT", "INT_TO_SINT(200)", -56), ("USINT", "INT_TO_USINT(-1)", 255), ("INT", "WORD_TO_INT(WORD#16#8000)", -32768),
        ("UINT", "DINT_TO_UINT(65537)", 1), ("BYTE", "INT_TO_BYTE(-2)", 254), ("BOOL", "INT_TO_BOOL(2)", True),
        ("LINT", "ULINT_TO_LINT(ULINT#18446744073709551615)", -1), ("INT", "BOOL_TO_INT(TRUE)", 1),
        # division and remainder: towards zero, the sign of the dividend; MOD 0 is 0
        ("INT", "-7 / 2", -3), ("INT", "7 / -2", -3), ("INT", "-7 MOD 2", -1), ("INT", "7 MOD -2", 1), ("INT", "i MOD 0", 0),
        # wrap around
        ("INT", "INT#32767 + i", -32768 + 4), ("SINT", "ABS(SINT#-128)", -128), ("UINT", "UINT#0 - UINT#1", 65535),
        ("ULINT", "ULINT#18446744073709551615 + ULINT#2", 1), ("INT", "-INT#-32768", -32768),
        # precedence: NOT and sign, **, * / MOD, + -, comparison, equality, AND, XOR, OR
        ("INT", "2 + 3 * 4 - 10 / 5", 12), ("LREAL", "2.0 ** 3.0 ** 2.0", 64.0), ("LREAL", "-2.0 ** 2.0", 4.0),
        ("BOOL", "TRUE OR TRUE AND FALSE", True), ("BOOL", "TRUE XOR TRUE OR TRUE", True), ("BOOL", "NOT FALSE AND FALSE", False),
        ("BOOL", "1 < 2 = TRUE", True), ("BOOL", "1 + 1 = 2 AND 3 > 2", True),
        # bits
        ("BYTE", "SHL(BYTE#16#81, 1)", 2), ("BYTE", "SHR(BYTE#16#81, 1)", 0x40), ("BYTE", "ROL(BYTE#16#81, 1)", 3),
        ("BYTE", "ROR(BYTE#16#81, 1)", 0xC0), ("BYTE", "SHL(BYTE#1, 8)", 0), ("BYTE", "ROL(BYTE#1, 9)", 2),
        ("WORD", "NOT WORD#16#00FF", 0xFF00), ("BYTE", "BYTE#16#F0 XOR BYTE#16#FF", 0x0F), ("WORD", "BYTE#16#FF", 0xFF),
        # strings: positions from 1; positions outside do not exist
        ("STRING", "LEFT('ASTR', 3)", "AST"), ("STRING", "LEFT('ab', 9)", "ab"), ("STRING", "LEFT('ab', -1)", ""),
        ("STRING", "RIGHT('ASTR', 3)", "STR"), ("STRING", "RIGHT('ab', 0)", ""), ("STRING", "RIGHT('ab', 9)", "ab"),
        ("STRING", "MID('ASTR', 2, 2)", "ST"), ("STRING", "MID('ab', 5, 2)", "b"), ("STRING", "MID('ab', 1, 9)", ""),
        ("STRING", "MID('ab', -1, 1)", ""), ("STRING", "MID('ab', 1, 0)", ""),
        ("STRING", "INSERT('ABC', 'XY', 2)", "ABXYC"), ("STRING", "INSERT('ABC', 'XY', 0)", "XYABC"),
        ("STRING", "INSERT('ABC', 'XY', 99)", "ABCXY"), ("STRING", "INSERT('ABC', 'XY', -3)", "XYABC"),
        ("STRING", "DELETE('ABXYC', 2, 3)", "ABC"), ("STRING", "DELETE('ab', -1, 1)", "ab"),
        ("STRING", "DELETE('ab', 9, 2)", "a"),
        ("STRING", "REPLACE('ABCDE', 'X', 2, 3)", "ABXE"), ("STRING", "REPLACE('ab', 'X', 0, 2)", "aXb"),
        ("INT", "FIND('ABCBC', 'BC')", 2), ("INT", "FIND('abc', 'x')", 0), ("INT", "FIND('abc', '')", 0),
        ("STRING[3]", "CONCAT('ab', 'cd')", "abc"), ("INT", "LEN('')", 0), ("STRING", "CONCAT('a', '', 'b')", "ab"),
        ("STRING", "REAL_TO_STRING(REAL#1.5)", "1.5"), ("STRING", "BOOL_TO_STRING(TRUE)", "TRUE"),
        ("STRING", "INT_TO_STRING(-7)", "-7"),
        ("BOOL", "'abc' < 'abd'", True), ("BOOL", "'B' < 'a'", True), ("STRING", "MAX('a', 'b')", "b"),
        # times
        ("TIME", "T#1h30m - T#45m", 45 * 60 * 10**9), ("TIME", "T#1s * 2.5", 2_500_000_000), ("TIME", "2 * T#3ms", 6_000_000),
        ("TIME", "T#1s / 3", 333_333_333), ("TIME", "T#1s / 0.5", 2_000_000_000), ("TIME", "-T#5s", -5_000_000_000),
        ("BOOL", "T#24h = T#1d", True), ("DINT", "TIME_TO_DINT(T#1m)", 60_000), ("TIME", "DINT_TO_TIME(1500)", 1_500_000_000),
        ("LINT", "LTIME_TO_LINT(LT#1us)", 1000), ("LREAL", "TIME_TO_LREAL(T#1s500ms)", 1500.0),
        ("STRING", "TIME_TO_STRING(T#1h0m5s)", "T#1h5s"), ("STRING", "TIME_TO_STRING(T#-1500us)", "T#-1ms500us"),
        ("DT", "DT#2024-02-28-23:59:59 + T#1s", 1_709_164_800 * 10**9),
        ("TIME", "D#2024-03-01 - D#2024-02-28", 2 * 86_400 * 10**9),
        ("TIME", "TOD#06:00 - TOD#05:30", 1800 * 10**9), ("DATE", "DT_TO_DATE(DT#2024-02-29-12:00:00)", 1_709_164_800 * 10**9),
        # selection
        ("INT", "SEL(FALSE, 1, 2)", 1), ("INT", "MUX(2, 10, 20, 30)", 30), ("INT", "LIMIT(0, 7, 5)", 5),
        ("INT", "MAX(1, 9, 4)", 9),
        ("LREAL", "SEL(TRUE, 1.0, 2.0) * 2.0", 4.0), ("LREAL", "MAX(1.5, 2.5) + SQRT(4.0)", 4.5), ("LREAL", "-SQRT(4)", -2.0),
        # operators by name
        ("INT", "ADD(1, 2, 3)", 6), ("INT", "SUB(1, MUL(2, 3))", -5), ("INT", "DIV(7, 2)", 3), ("BOOL", "GE(2, 2)", True),
        ("BOOL", "NE('a', 'b')", True), ("TIME", "ADD(T#1s, T#1s)", 2_000_000_000),
    ],
)  # fmt: skip
def test_values_at_the_edges(kind: str, expression: str, expected: object) -> None:
    got = value(kind, expression, "i : INT := 5;")
    assert got == expected
    assert type(got) is type(expected)


@pytest.mark.parametrize(
    ("expression", "told"),
    [
        ("LREAL_TO_INT(32767.5)", "does not fit"), ("REAL_TO_INT(r)", "does not fit"), ("MUX(i, 1, 2)", "outside its array"),
        ("STRING_TO_INT('1e3')", "not a whole number"), ("STRING_TO_INT('')", "not a whole number"),
        ("STRING_TO_INT('40000')", "does not fit"), ("i / 0", "division by zero"), ("TIME_TO_INT(T#1s / r0)", "division by zero"),
        ("REAL_TO_INT(SQRT(0.0 - r))", "no value here"), ("LREAL_TO_INT(r0 ** -1.0)", "zero to a negative power"),
        ("TIME_TO_INT(T#1s * r * r)", "does not fit"),
    ],
)  # fmt: skip
def test_a_missing_value_stops_the_task(expression: str, told: str) -> None:
    with pytest.raises(LogicError, match=told):
        value("INT", expression, "i : INT := 5; r : REAL := 1e30; r0 : REAL;")


# -- partial access (IEC 61131-3:2013, 6.5.4.4 and table 17) ----------------------------------------------------------------


@pytest.mark.parametrize(
    ("expression", "kind", "expected"),
    [
        ("l.%X60", "BOOL", True),
        ("l.%B0", "BYTE", 0x88),
        ("l.%B7", "BYTE", 0x11),
        ("l.%W1", "WORD", 0x5566),
        ("l.%D1", "DWORD", 0x11223344),
        ("l.%b6", "BYTE", 0x22),
        ("d.%B3", "BYTE", 0xAA),
        ("w[1].%B1", "BYTE", 0x12),
        ("l.%X3", "BOOL", True),
    ],
)
def test_a_part_of_a_bit_string_is_counted_from_its_least_significant_end(
    expression: str, kind: str, expected: int
) -> None:
    variables = "l : LWORD := 16#1122334455667788; d : DWORD := 16#AABBCCDD; w : ARRAY[0..1] OF WORD := [0, 16#1234];"
    assert value(kind, expression, variables) == expected


def test_an_assignment_to_a_part_keeps_the_rest() -> None:
    found = run(
        "l, m : LWORD := 16#1122334455667788; w : ARRAY[0..1] OF WORD := [0, 16#1234]; b : BYTE := 16#FF;",
        "l.%B0 := 16#AB; l.%W3 := 0; l.%X16 := TRUE; m.%D1 := l.%D0; w[1].%B1 := b; b.%X7 := FALSE;",
    )
    assert (found["l"], found["m"]) == (0x00003344556777AB, 0x556777AB55667788)
    assert (found["w"], found["b"]) == ([0, 0xFF34], 0x7F)


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ("b := w.%B2;", "WORD has BYTEs 0 to 1"),
        ("b := b.%B0;", "BYTE has no BYTEs"),
        ("x := w.%X16;", "WORD has bits 0 to 15"),
        ("b := i.%B0;", "a bit string"),
        ("w.%B0 := w;", "BYTE"),
        ("b := w.%Q0;", "not Structured Text"),
    ],
)
def test_a_part_that_does_not_exist_is_an_error(body: str, message: str) -> None:
    with pytest.raises(FileInvalid, match=message):
        run("w : WORD; b : BYTE; x : BOOL; i : INT;", body)
