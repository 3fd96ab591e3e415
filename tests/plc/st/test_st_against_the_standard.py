"""Operators, standard functions, conversions and blocks against an independent reference written from IEC 61131-3.

The reference does not use the compiler: it computes with Python's integers, `decimal` and `struct`, by the clauses and tables
that each test names. Where the standard leaves a result open, docs/reference/plc.md defines it.
"""

from __future__ import annotations

import math
import struct
from decimal import ROUND_HALF_EVEN, Decimal
from functools import cache
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from st_bench import program, run, scan, value

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.plc.st.program import StProgram
from fieldtwin.plc.st.values import LogicError

WIDTH = {"SINT": 8, "INT": 16, "DINT": 32, "LINT": 64, "USINT": 8, "UINT": 16, "UDINT": 32, "ULINT": 64}
BITS = {"BYTE": 8, "WORD": 16, "DWORD": 32, "LWORD": 64}
DAY = 86_400_000_000_000
settings.register_profile("reference", deadline=None, max_examples=150)
CASES = settings.get_profile("reference")


def limits(kind: str) -> tuple[int, int]:
    bits = WIDTH.get(kind) or BITS[kind]
    return (0, 2**bits - 1) if kind.startswith("U") or kind in BITS else (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1)


def kept(x: int, kind: str) -> int:
    """Return `x` in the width of `kind`: two's complement."""
    low, high = limits(kind)
    return (x - low) % (high - low + 1) + low


def of(kind: str) -> st.SearchStrategy[int]:
    low, high = limits(kind)
    edges = [low, low + 1, -1, 0, 1, high - 1, high]
    return st.one_of(st.integers(low, high), st.sampled_from([e for e in edges if low <= e <= high]))


@cache
def _program(result: str, expression: str, kinds: tuple[str, ...]) -> StProgram:
    declared = " ".join(f"x{n} : {kind};" for n, kind in enumerate(kinds))
    return program(f"PROGRAM p VAR {declared} result : {result}; END_VAR\nresult := {expression};\nEND_PROGRAM")


def worked_out(result: str, expression: str, *given_values: tuple[str, Any]) -> Any:
    """Evaluate `expression` of x0, x1, ... with these kinds and values."""
    made = _program(result, expression, tuple(kind for kind, _ in given_values))
    for n, (_, given_value) in enumerate(given_values):
        setattr(made.st_body, f"v_x{n}", given_value)
    scan(made)
    return made.st_body.v_result


NO_RESULT = object()


def or_none(result: str, expression: str, *given_values: tuple[str, Any]) -> Any:
    try:
        return worked_out(result, expression, *given_values)
    except LogicError:
        return NO_RESULT


# -- arithmetic: Table 29, 6.6.2.5.3 -----------------------------------------------------------------------------------


@CASES
@given(st.data(), st.sampled_from(sorted(WIDTH)), st.sampled_from(["+", "-", "*", "/", "MOD"]))
def test_integer_arithmetic_wraps_around(data: st.DataObject, kind: str, op: str) -> None:
    a, b = data.draw(of(kind)), data.draw(of(kind))
    if op == "/":
        exact: Any = NO_RESULT if b == 0 else int(Decimal(a) / Decimal(b)) if abs(a) < 2**40 else _quotient(a, b)
    elif op == "MOD":
        exact = 0 if b == 0 else a - b * _quotient(a, b)
    else:
        exact = {"+": a + b, "-": a - b, "*": a * b}[op]
    expected = exact if exact is NO_RESULT else kept(exact, kind)
    assert or_none(kind, f"x0 {op} x1", (kind, a), (kind, b)) == expected


def _quotient(a: int, b: int) -> int:
    """Truncate towards zero: the largest whole number of times that b fits into a, with the sign of the exact quotient."""
    q = abs(a) // abs(b)
    return q if (a >= 0) == (b >= 0) else -q


@CASES
@given(st.data(), st.sampled_from(sorted(WIDTH)))
def test_sign_and_absolute_value(data: st.DataObject, kind: str) -> None:
    a = data.draw(of(kind))
    assert worked_out(kind, "-x0", (kind, a)) == kept(-a, kind)
    assert worked_out(kind, "ABS(x0)", (kind, a)) == kept(abs(a), kind)


# -- bit strings: Table 30, 6.6.2.5.5 ----------------------------------------------------------------------------------


@CASES
@given(st.data(), st.sampled_from(sorted(BITS)), st.sampled_from(["SHL", "SHR", "ROL", "ROR"]))
def test_shifts_and_rotations(data: st.DataObject, kind: str, name: str) -> None:
    bits = BITS[kind]
    a = data.draw(of(kind))
    n = data.draw(st.one_of(st.integers(-3, 3 * bits), st.sampled_from([0, bits - 1, bits, bits + 1, 32767])))
    digits = f"{a:0{bits}b}"
    for _ in range(max(0, n)):
        digits = {
            "SHL": digits[1:] + "0", "SHR": "0" + digits[:-1], "ROL": digits[1:] + digits[0], "ROR": digits[-1] + digits[:-1],
        }[name]  # fmt: skip
    expected = NO_RESULT if n < 0 else int(digits, 2)  # a negative count is an error
    assert or_none(kind, f"{name}(x0, x1)", (kind, a), ("INT", n)) == expected


@CASES
@given(st.data(), st.sampled_from(sorted(BITS)), st.sampled_from(["AND", "OR", "XOR"]))
def test_bitwise_operators(data: st.DataObject, kind: str, op: str) -> None:
    a, b = data.draw(of(kind)), data.draw(of(kind))
    table = {"AND": {"11"}, "OR": {"01", "10", "11"}, "XOR": {"01", "10"}}[op]
    bits = BITS[kind]
    pairs = zip(f"{a:0{bits}b}", f"{b:0{bits}b}", strict=True)
    expected = int("".join("1" if x + y in table else "0" for x, y in pairs), 2)
    assert worked_out(kind, f"x0 {op} x1", (kind, a), (kind, b)) == expected
    assert worked_out(kind, f"{op}(IN2 := x1, IN1 := x0)", (kind, a), (kind, b)) == expected
    assert value(kind, f"{a} {op} {b}") == expected  # constants without a type: the context gives the width
    assert worked_out(kind, "NOT x0", (kind, a)) == 2**bits - 1 - a


def test_untyped_constants_are_bit_strings_where_bits_are_required() -> None:
    assert value("INT", "2#1010 AND 2#1100") == 0b1000
    assert value("BYTE", "2#1010 OR 16#F0") == 0xFA
    assert value("WORD", "16#FF00 XOR 16#0FF0 AND 16#F") == 0xFF00
    with pytest.raises(FileInvalid, match="operands of AND"):
        value("INT", "-1 AND 3")
    with pytest.raises(FileInvalid, match="assigned to"):
        value("BYTE", "16#F00 OR 1")


# -- conversions: Tables 22 to 27, 6.6.2.5.2 ---------------------------------------------------------------------------


@CASES
@given(st.data(), st.sampled_from(sorted(WIDTH)), st.sampled_from(sorted(WIDTH)))
def test_integers_keep_the_bits_that_fit(data: st.DataObject, source: str, target: str) -> None:
    a = data.draw(of(source))
    assert worked_out(target, f"{source}_TO_{target}(x0)", (source, a)) == kept(a, target)


@CASES
@given(st.floats(-70_000, 70_000), st.sampled_from([0.0, 0.5, 0.25, -0.5]), st.sampled_from(sorted(WIDTH)))
def test_reals_round_to_the_nearest_and_ties_to_the_even_one(x: float, part: float, target: str) -> None:
    for number in (x, math.floor(x) + part):
        low, high = limits(target)
        nearest = int(Decimal(number).quantize(Decimal(1), rounding=ROUND_HALF_EVEN))
        expected = nearest if low <= nearest <= high else NO_RESULT
        assert or_none(target, f"LREAL_TO_{target}(x0)", ("LREAL", number)) == expected
        cut = int(Decimal(number))
        expected = cut if low <= cut <= high else NO_RESULT
        assert or_none(target, f"LREAL_TRUNC_{target}(x0)", ("LREAL", number)) == expected


@CASES
@given(st.sampled_from([("BYTE", "USINT"), ("WORD", "UINT"), ("DWORD", "UDINT"), ("LWORD", "ULINT")]), st.data())
def test_binary_coded_decimals(kinds: tuple[str, str], data: st.DataObject) -> None:
    bits, number = kinds
    digits = data.draw(st.text("0123456789ABCDEF", min_size=1, max_size=BITS[bits] // 4))
    coded = int(digits, 16)
    expected = int(digits) if digits.isdecimal() else NO_RESULT
    assert or_none(number, f"{bits}_BCD_TO_{number}(x0)", (bits, coded)) == expected
    n = data.draw(of(number))
    fits = n < 10 ** (BITS[bits] // 4)
    assert or_none(bits, f"{number}_TO_BCD_{bits}(x0)", (number, n)) == (int(str(n), 16) if fits else NO_RESULT)


@CASES
@given(st.data(), st.sampled_from(sorted(WIDTH)), st.sampled_from([10, 16, 8, 2]), st.sampled_from(["", " ", "  "]))
def test_strings_hold_literals(data: st.DataObject, kind: str, base: int, around: str) -> None:
    n = data.draw(of(kind))
    if base != 10:
        n = abs(n) % 2**15
    text = str(n) if base == 10 else f"{base}#{n:{ {16: 'X', 8: 'o', 2: 'b'}[base] }}"
    low, high = limits(kind)
    expected = n if low <= n <= high else NO_RESULT
    assert or_none(kind, f"STRING_TO_{kind}(x0)", ("STRING[90]", f"{around}{text}{around}")) == expected


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("16#FF", 255), ("16#ff", 255), ("2#1111_1111", 255), ("8#17", 15), (" 1_000 ", 1000), ("-12", -12), ("+12", 12),
        ("16#", NO_RESULT), ("16#G", NO_RESULT), ("2#2", NO_RESULT), ("3#1", NO_RESULT), ("-16#1", NO_RESULT), ("", NO_RESULT),
        ("1.5", NO_RESULT), ("12x", NO_RESULT), ("16#8000", NO_RESULT), ("0x10", NO_RESULT),
    ],
)  # fmt: skip
def test_a_string_that_is_converted_to_an_integer(text: str, expected: object) -> None:
    assert or_none("INT", "STRING_TO_INT(x0)", ("STRING", text)) == expected


# -- strings: Table 34 (positions count from 1) ------------------------------------------------------------------------


@CASES
@given(st.text("abc", max_size=6), st.text("abc", max_size=3), st.integers(-2, 8), st.integers(-2, 8))
def test_string_functions(a: str, b: str, n: int, p: int) -> None:
    chars, length, place = list(a), max(0, n), p - 1
    given_values = ("STRING", a), ("STRING", b), ("INT", n), ("INT", p)
    inside = [c for i, c in enumerate(chars) if place <= i < place + length]
    outside = [c for i, c in enumerate(chars) if not place <= i < place + length]
    at = next((i for i in range(len(a) - len(b) + 1) if a[i : i + len(b)] == b), -1) + 1
    expected = {
        "LEFT(x0, x2)": "".join(chars[:length]),
        "RIGHT(x0, x2)": "".join(chars[len(chars) - min(length, len(chars)) :]),
        "MID(x0, x2, x3)": "".join(inside) if p > 0 else "",
        "DELETE(x0, x2, x3)": "".join(outside) if p > 0 else a,
        "INSERT(x0, x1, x3)": "".join([*chars[: max(0, p)], b, *chars[max(0, p) :]]),
        "REPLACE(x0, x1, x2, x3)": "".join([*chars[:place], b, *chars[place + length :]]) if p > 0 else a,
        "CONCAT(x0, x1)": "".join(chars + list(b)),
    }
    for expression, text in expected.items():
        assert worked_out("STRING", expression, *given_values) == text, expression
    assert worked_out("INT", "FIND(x0, x1)", *given_values) == (at if b else 0)
    assert worked_out("INT", "LEN(x0)", *given_values) == len(chars)
    assert worked_out("STRING[2]", "CONCAT(x0, x1)", *given_values) == (a + b)[:2]


# -- selection and comparison: Tables 32 and 33 ------------------------------------------------------------------------


@CASES
@given(st.lists(st.integers(-5, 5), min_size=3, max_size=3), st.booleans(), st.integers(-1, 4))
def test_selection_and_comparison(three: list[int], g: bool, k: int) -> None:
    a, b, c = three
    given_values = ("INT", a), ("INT", b), ("INT", c), ("BOOL", g), ("INT", k)
    expected: dict[tuple[str, str], Any] = {
        ("INT", "MAX(x0, x1, x2)"): sorted(three)[-1],
        ("INT", "MIN(x0, x1, x2)"): sorted(three)[0],
        ("INT", "LIMIT(x0, x1, x2)"): min(max(b, a), c),
        ("INT", "SEL(x3, x0, x1)"): b if g else a,
        ("INT", "MUX(x4, x0, x1, x2)"): three[k] if 0 <= k < 3 else NO_RESULT,
        ("BOOL", "GT(x0, x1, x2)"): a > b and b > c,
        ("BOOL", "GE(x0, x1, x2)"): a >= b and b >= c,
        ("BOOL", "EQ(x0, x1, x2)"): a == b and b == c,
        ("BOOL", "LE(x0, x1, x2)"): a <= b and b <= c,
        ("BOOL", "LT(x0, x1, x2)"): a < b and b < c,
        ("BOOL", "NE(x0, x1)"): a != b,
    }
    for (kind, expression), result in expected.items():
        assert or_none(kind, expression, *given_values) == result, expression


# -- times: Table 35 ---------------------------------------------------------------------------------------------------


@CASES
@given(st.integers(0, DAY - 1), st.integers(-3 * DAY, 3 * DAY))
def test_a_time_of_day_wraps_at_midnight(tod: int, duration: int) -> None:
    for op, exact in (("+", tod + duration), ("-", tod - duration)):
        name = {"+": "ADD_TOD_TIME", "-": "SUB_TOD_TIME"}[op]
        for expression in (f"x0 {op} x1", f"{name}(x0, x1)"):
            assert worked_out("TOD", expression, ("TOD", tod), ("TIME", duration)) == exact % DAY


def test_time_of_day_wraps_at_midnight() -> None:
    assert value("TOD", "TOD#23:00:00 + T#2h") == 3600 * 10**9
    assert value("TOD", "TOD#01:00:00 - T#2h") == 23 * 3600 * 10**9
    assert value("STRING", "TOD_TO_STRING(TOD#23:59:59 + T#1s)") == "TOD#00:00:00"
    assert value("TIME", "TOD#01:00:00 - TOD#02:00:00") == -3600 * 10**9


@CASES
@given(st.integers(-(10**12), 10**12), st.integers(-(10**12), 10**12), st.integers(-1000, 1000))
def test_arithmetic_of_durations(a: int, b: int, n: int) -> None:
    given_values = ("TIME", a), ("TIME", b), ("INT", n)
    assert worked_out("TIME", "x0 + x1", *given_values) == a + b
    assert worked_out("TIME", "SUB_TIME(IN2 := x1, IN1 := x0)", *given_values) == a - b
    assert worked_out("TIME", "x0 * x2", *given_values) == a * n
    assert or_none("TIME", "DIV_TIME(x0, x2)", *given_values) == (_quotient(a, n) if n else NO_RESULT)


# -- REAL: IEC 60559 ---------------------------------------------------------------------------------------------------


@CASES
@given(
    st.floats(width=32, allow_nan=False, allow_infinity=False),
    st.floats(width=32, allow_nan=False, allow_infinity=False),
)
def test_real_arithmetic_rounds_to_32_bits(a: float, b: float) -> None:
    def narrow(x: float) -> float:
        try:
            return float(struct.unpack("<f", struct.pack("<f", x))[0])
        except OverflowError:
            return math.copysign(math.inf, x)

    for op, exact in (("+", a + b), ("-", a - b), ("*", a * b)):
        assert worked_out("REAL", f"x0 {op} x1", ("REAL", a), ("REAL", b)) == narrow(exact)
    assert or_none("REAL", "x0 / x1", ("REAL", a), ("REAL", b)) == (narrow(a / b) if b else NO_RESULT)


# -- CASE: 7.3.3.3.3 ---------------------------------------------------------------------------------------------------


@settings(deadline=None, max_examples=40)
@given(st.lists(st.tuples(st.integers(-40, 40), st.integers(0, 6)), max_size=70), st.booleans())
def test_case_takes_the_branch_that_has_the_value(ranges: list[tuple[int, int]], otherwise: bool) -> None:
    branches: list[tuple[int, int]] = []
    for low, more in ranges:
        if all(low + more < other or low > top for other, top in branches):
            branches.append((low, low + more))
    text = " ".join(f"{low}..{high}: r := {n};" for n, (low, high) in enumerate(branches, 1))
    made = program(
        f"PROGRAM p VAR x, r : INT; END_VAR r := 0; CASE x OF {text} {'ELSE r := -1;' if otherwise else ''} END_CASE END_PROGRAM"
    )
    for x in range(-45, 50):
        made.st_body.v_x = x
        scan(made)
        found = next((n for n, (low, high) in enumerate(branches, 1) if low <= x <= high), -1 if otherwise else 0)
        assert made.st_body.v_r == found


# -- blocks: 6.6.3.5, with the standard's timing diagrams and bodies ---------------------------------------------------


BLOCKS = """PROGRAM p VAR i, r, d, l : BOOL; pt : TIME; pv : INT; END_VAR
VAR on : TON; off : TOF; pulse : TP; up : CTU; down : CTD; both : CTUD; END_VAR
VAR rise : R_TRIG; fall : F_TRIG; set : SR; reset : RS; END_VAR
on(IN := i, PT := pt); off(IN := i, PT := pt); pulse(IN := i, PT := pt);
up(CU := i, R := r, PV := pv); down(CD := i, LD := l, PV := pv); both(CU := i, CD := d, R := r, LD := l, PV := pv);
rise(CLK := i); fall(CLK := i); set(S1 := i, R := r); reset(S := i, R1 := r);
END_PROGRAM"""
STEPS = st.lists(
    st.tuples(st.booleans(), st.booleans(), st.booleans(), st.booleans(), st.sampled_from([5, 10, 15, 20, 30])),
    max_size=40,
)


@settings(deadline=None, max_examples=80)
@given(STEPS, st.sampled_from([0, 10, 25, 30]), st.integers(-1, 3))
def test_blocks_follow_the_diagrams_of_the_standard(
    steps: list[tuple[bool, bool, bool, bool, int]], pt: int, pv: int
) -> None:
    made = program(BLOCKS)
    body = made.st_body
    body.v_pt, body.v_pv = pt * 1_000_000, pv
    at = 0
    on_since: int | None = None  # the time since IN is true, as seen by scans
    off_since: int | None = None  # the time since it is false after having been true
    pulse_since: int | None = None
    before = before_d = shown = False
    before_i_for_fall = False
    up = down = both = 0
    set_ = reset = False
    for number, (i, r, d, ld, ms) in enumerate(steps, 1):
        at += ms
        body.v_i, body.v_r, body.v_d, body.v_l = i, r, d, ld
        scan(made, number, ms=at)
        on_since = (at if on_since is None else on_since) if i else None
        assert (on_since is not None and at - on_since >= pt) == body.v_on.Q
        assert (min(at - on_since, pt) * 1_000_000 if on_since is not None else 0) == body.v_on.ET
        off_since = None if i else at if before else off_since
        assert (i or (off_since is not None and at - off_since < pt)) == body.v_off.Q
        pulsing = pulse_since is not None and at - pulse_since < pt
        if i and not before and not shown:
            pulse_since, pulsing = at, pt > 0
        assert pulsing == body.v_pulse.Q
        shown = pulsing
        assert (i and not before, not i and not before_i_for_fall) == (body.v_rise.Q, body.v_fall.Q)
        before_i_for_fall = not i
        up = 0 if r else up + (i and not before)
        down = pv if ld else down - (i and not before)
        counted_up, counted_down = i and not before, d and not before_d
        both = 0 if r else pv if ld else both + (counted_up and not counted_down) - (counted_down and not counted_up)
        assert (up, up >= pv) == (body.v_up.CV, body.v_up.Q)
        assert (down, down <= 0) == (body.v_down.CV, body.v_down.Q)
        assert (both, both >= pv, both <= 0) == (body.v_both.CV, body.v_both.QU, body.v_both.QD)
        set_, reset = i or (set_ and not r), not r and (i or reset)
        assert (set_, reset) == (body.v_set.Q1, body.v_reset.Q1)
        before, before_d = i, d


def test_edges_and_timers_in_the_very_first_scan() -> None:
    got = run(
        "r : R_TRIG; f : F_TRIG; a, b : BOOL; t : TON; p : TP;",
        """r(CLK := TRUE); f(CLK := FALSE); a := r.Q; b := f.Q;
        t(IN := TRUE, PT := T#0s); p(IN := TRUE, PT := T#0s);""",
    )
    assert (got["a"], got["b"], got["t"].Q, got["p"].Q) == (True, True, True, False)
