"""Expressions of Structured Text: values, widths, precedence, conversions, and the errors of wrong types."""

from __future__ import annotations

import math
import struct

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from st_bench import run, value

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.plc.st.values import LogicError

INTEGERS = {"SINT": 8, "INT": 16, "DINT": 32, "LINT": 64}


@pytest.mark.parametrize(
    ("kind", "expression", "expected"),
    [
        ("INT", "2 + 3 * 4", 14),
        ("INT", "(2 + 3) * 4", 20),
        ("INT", "-7 / 2", -3),
        ("INT", "-7 MOD 2", -1),
        ("INT", "7 MOD 0", 0),
        ("INT", "16#FF", 255),
        ("INT", "2#1010_0101", 165),
        ("INT", "8#17", 15),
        ("DINT", "1_000_000", 1_000_000),
        ("DINT", "INT#-5", -5),
        ("LREAL", "2.0 ** 3", 8.0),
        ("LREAL", "-2.0 ** 2.0", 4.0),  # the standard's table: a sign binds tighter than **
        ("LREAL", "1.5e3", 1500.0),
        ("REAL", "0.1", struct.unpack("<f", struct.pack("<f", 0.1))[0]),
        ("BOOL", "TRUE XOR TRUE OR TRUE", True),
        ("BOOL", "NOT FALSE AND FALSE", False),
        ("BOOL", "1 < 2 = TRUE", True),
        ("BOOL", "3 > 2 AND 'b' > 'a'", True),
        ("BOOL", "1", True),
        ("WORD", "WORD#16#F0F0 AND 16#00FF", 0x00F0),
        ("BYTE", "NOT BYTE#16#0F", 0xF0),
        ("WORD", "ROL(WORD#16#8001, 1)", 3),
        ("WORD", "SHR(WORD#16#8001, 15)", 1),
        ("BYTE", "SHL(BYTE#16#81, 9)", 0),
        ("WORD", "SHL(IN := 16#0001, N := 4)", 16),
        ("BYTE", "SHL(16#81, 1)", 2),
        ("WORD", "SHR(16#8001, 15)", 1),
        ("BYTE", "ROL(16#81, 1)", 3),
        ("DWORD", "ROR(1, 1)", 0x8000_0000),
        ("WORD", "SHL(SHL(1, 2), 3)", 32),
        ("WORD", "WORD#16#F0 OR SHL(1, 2)", 0xF4),
        ("WORD", "SHL(1, 2) OR 16#F0", 0xF4),
        ("WORD", "OR(SHL(1, 2), 16#F0)", 0xF4),
        ("WORD", "WORD#16#FFFF AND NOT 16#000F", 0xFFF0),
        ("WORD", "NOT 16#000F", 0xFFF0),
        ("BOOL", "SHL(1, 2) = BYTE#4", True),
        ("BOOL", "BYTE#4 = SHL(1, 2)", True),
        ("WORD", "SEL(TRUE, 16#0001, 16#8000)", 0x8000),
        ("WORD", "MUX(1, SHL(1, 1), 16#8000)", 0x8000),
        ("BYTE", "LIMIT(0, 16#FF, 16#0F)", 15),
        ("USINT", "LIMIT(0, 150, 200)", 150),
        ("LREAL", "MAX(3, 9)", 9.0),
        ("WORD", "AND(16#FF, 16#0F)", 15),
        ("WORD", "XOR(16#FF, SHL(1, 0))", 0xFE),
        ("TIME", "T#1h2m3s4ms", 3_723_004_000_000),
        ("TIME", "T#-1.5s", -1_500_000_000),
        ("TIME", "T#90m - T#0.5h", 3_600_000_000_000),
        ("TIME", "T#1s * 3 / 2", 1_500_000_000),
        ("LTIME", "LTIME#1us2ns", 1002),
        ("TIME", "DT#2026-01-02-00:00:00 - DT#2026-01-01-12:00:00", 43_200 * 10**9),
        ("TIME_OF_DAY", "TOD#23:30:00.5", 84_600_500_000_000),
        ("DATE", "D#1970-01-02", 86_400 * 10**9),
        ("STRING", "'a$'b$24$N'", "a'b$\n"),
        ("WSTRING", '"\u20ac$20AC"', "\u20ac\u20ac"),
        ("STRING[3]", "'abcdef'", "abc"),
        ("INT", "LEN(CONCAT('ab', 'cd', 'e'))", 5),
        ("STRING", "MID('abcdef', 3, 2)", "bcd"),
        ("STRING", "LEFT('abcdef', 2)", "ab"),
        ("STRING", "RIGHT('abcdef', 2)", "ef"),
        ("STRING", "INSERT('abc', 'XY', 1)", "aXYbc"),
        ("STRING", "DELETE('abcdef', 2, 3)", "abef"),
        ("STRING", "REPLACE('abcdef', 'X', 2, 3)", "abXef"),
        ("INT", "FIND('abcabc', 'ca')", 3),
        ("INT", "FIND('abc', 'x')", 0),
        ("REAL", "SQRT(16.0)", 4.0),
        ("INT", "MAX(3, 9, 5)", 9),
        ("INT", "LIMIT(0, 15, 10)", 10),
        ("INT", "SEL(TRUE, 1, 2)", 2),
        ("INT", "MUX(2, 10, 20, 30)", 30),
        ("INT", "ABS(-4)", 4),
        ("INT", "REAL_TO_INT(2.5)", 2),
        ("INT", "REAL_TO_INT(3.5)", 4),
        ("LINT", "TRUNC(-2.9)", -2),
        ("INT", "REAL_TRUNC_INT(2.9)", 2),
        ("SINT", "INT_TO_SINT(200)", -56),
        ("UINT", "INT_TO_UINT(-1)", 65535),
        ("BYTE", "WORD_TO_BYTE(16#1234)", 0x34),
        ("DINT", "TIME_TO_DINT(T#1.5s)", 1500),
        ("TIME", "DINT_TO_TIME(20)", 20_000_000),
        ("LINT", "LTIME_TO_LINT(LTIME#3us)", 3000),
        ("STRING", "TIME_TO_STRING(T#61s)", "T#1m1s"),
        ("STRING", "REAL_TO_STRING(2.0)", "2.0"),
        ("STRING", "BOOL_TO_STRING(TRUE)", "TRUE"),
        ("INT", "STRING_TO_INT(' 42 ')", 42),
        ("LREAL", "STRING_TO_LREAL('1e3')", 1000.0),
        ("TIME_OF_DAY", "DT_TO_TOD(DT#2026-01-01-06:00:00)", 6 * 3600 * 10**9),
        ("INT", "TO_INT(7.6)", 8),
    ],
)
def test_value_of_an_expression(kind: str, expression: str, expected: object) -> None:
    got = value(kind, expression)
    assert got == expected
    assert type(got) is type(expected)


@settings(deadline=None)  # the first example builds the parser
@given(st.sampled_from(sorted(INTEGERS)), st.sampled_from("+-*"), st.integers(), st.integers())
def test_integers_wrap_at_their_width(kind: str, op: str, a: int, b: int) -> None:
    bits = INTEGERS[kind]

    def narrowed(x: int) -> int:
        return (x + 2 ** (bits - 1)) % 2**bits - 2 ** (bits - 1)

    a, b = narrowed(a), narrowed(b)
    exact = {"+": a + b, "-": a - b, "*": a * b}[op]
    assert value(kind, f"a {op} b", f"a : {kind} := {a}; b : {kind} := {b};") == narrowed(exact)


@settings(deadline=None)  # the first example builds the parser
@given(st.integers(-128, 127), st.integers(-128, 127).filter(bool))
def test_division_truncates_and_the_remainder_goes_with_it(a: int, b: int) -> None:
    v = f"a : DINT := {a}; b : DINT := {b};"
    q, r = value("DINT", "a / b", v), value("DINT", "a MOD b", v)
    assert q == math.trunc(a / b)
    assert q * b + r == a


@settings(deadline=None)  # the first example builds the parser
@given(st.floats(-1e30, 1e30), st.floats(-1e30, 1e30))
def test_real_arithmetic_is_that_of_32_bits(a: float, b: float) -> None:
    def f(x: float) -> float:
        try:
            return float(struct.unpack("<f", struct.pack("<f", x))[0])
        except OverflowError:
            return math.copysign(math.inf, x)

    v = f"a : REAL := {a:e}; b : REAL := {b:e};"
    assert value("REAL", "a * b", v) == f(f(float(f"{a:e}")) * f(float(f"{b:e}")))


def test_types_widen_and_never_narrow_unasked() -> None:
    v = "s : SINT := -3; u : USINT := 200; i : INT := 7; r : REAL := 1.5; by : BYTE := 16#F0;"
    assert value("LINT", "s + i", v) == 4
    assert value("LREAL", "r * i", v) == 10.5
    assert value("DINT", "u", v) == 200
    assert value("DWORD", "by OR DWORD#16#100", v) == 0x1F0


@pytest.mark.parametrize(
    ("kind", "expression", "told"),
    [
        ("INT", "d", "expected INT; got DINT (DINT_TO_INT)"),
        ("UINT", "i", "expected UINT; got INT"),
        ("REAL", "d", "DINT_TO_REAL"),
        ("INT", "40000", "expected INT; got 40000"),
        ("USINT", "-1", "expected USINT"),
        ("BOOL", "i", "INT_TO_BOOL"),
        ("INT", "i AND i", "operands of AND"),
        ("INT", "i + b", "operands of +"),
        ("BOOL", "i = s", "operands of ="),
        ("INT", "SINT#200", "SINT holds -128 to 127"),
        ("INT", "16#FG", "not Structured Text"),
        ("TIME", "T#1s1h", "largest to the smallest"),
        ("DATE", "D#2026-02-30", "no such date"),
        ("STRING", "'$Q'", "not an escape"),
        ("INT", "nothing", "'nothing' is not declared"),
        ("INT", "lenght", "did you mean 'length'?"),
        ("INT", "LENN('a')", "a function 'LENN' is not declared (did you mean 'LEN'?)"),
        ("INT", "LEN('a', 'b')", "arguments of LEN; expected 1 (IN); got 2"),
        ("INT", "1 / 0", "division by zero"),
        ("INT", "INT_TO_NOTHING(1)", "not declared"),
        ("INT", "SHL(16#0001, 1)", "the width of this literal is unknown here"),
        ("INT", "SHL(i, 1)", "expected bits; got INT"),
        ("BYTE", "SHL(16#1FF, 1)", "WORD#16#0001"),
    ],
)
def test_invalid_programs_are_refused_with_their_place(kind: str, expression: str, told: str) -> None:
    with pytest.raises(FileInvalid, match=r"test\.st:3:") as e:
        value(kind, expression, "d : DINT; i : INT; b : BOOL; s : STRING; length : INT;")
    assert told in str(e.value)
    assert e.value.column >= 10


@pytest.mark.parametrize(
    ("expression", "told"),
    [
        ("i / z", "division by zero"),
        ("a[i + 9]", "an index outside its array; expected 0 to 3; got 10"),
        ("REAL_TO_INT(1.0e9 * i)", "does not fit"),
        ("STRING_TO_INT('x')", "not a whole number"),
        ("MUX(i, 5)", "outside"),
        ("TRUNC(SQRT(-1.0 * i))", "no value here"),
    ],
)
def test_an_undefined_result_is_an_error_of_the_logic(expression: str, told: str) -> None:
    target = "result : LINT; i : INT := 1; z : INT; a : ARRAY[0..3] OF INT;"
    with pytest.raises(LogicError, match=told):
        run(target, f"result := {expression};")
