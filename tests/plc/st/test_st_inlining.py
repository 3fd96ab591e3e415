"""The functions that are written into the compiled code give the results of the functions that they replace."""

from __future__ import annotations

import math
import struct
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from st_bench import program, scan

from fieldtwin.plc.st import values
from fieldtwin.plc.st.compiler.compile import compile_text
from fieldtwin.plc.st.program import StProgram

TEXT = """PROGRAM p
VAR_INPUT a, b : DINT; x, y : REAL; u : UDINT; END_VAR
VAR_OUTPUT remainder, quotient, nested, sum, difference, chained : DINT; narrow : INT; of_unsigned : UDINT; END_VAR
VAR_OUTPUT product, total, of_int : REAL; END_VAR
  remainder := a MOD 7;
  quotient := a / 7;
  nested := (a MOD 1000 + b) / 3 MOD 5;
  sum := a + 2147483647;
  difference := a - 5;
  chained := a + 1 - 2 + 3;
  narrow := DINT_TO_INT(a) - 32767;
  of_unsigned := u MOD 10 + u / 10;
  product := x * y;
  total := x + y;
  of_int := INT_TO_REAL(narrow);
END_PROGRAM
"""


def wrap(x: int) -> int:
    return values.signed(x, 32)


def single(x: float) -> float:
    """Round as the standard form does, and beyond the range to infinity."""
    try:
        return float(struct.unpack("<f", struct.pack("<f", x))[0])
    except OverflowError:
        return math.copysign(math.inf, x)


@pytest.fixture(scope="module")
def made() -> StProgram:
    return program(TEXT)


DINTS = st.integers(-(2**31), 2**31 - 1)
REALS = st.floats(width=32)


@given(DINTS, DINTS, st.integers(0, 2**32 - 1), REALS, REALS)
def test_inlined_operations_equal_the_functions(made: StProgram, a: int, b: int, u: int, x: float, y: float) -> None:
    made.a, made.b, made.u, made.x, made.y = a, b, u, x, y
    scan(made)
    narrow = values.signed(values.signed(a, 16) - 32767, 16)
    expected: dict[str, Any] = {
        "remainder": values.modulo(a, 7),
        "quotient": values.divide(a, 7),
        "nested": values.modulo(values.divide(wrap(values.modulo(a, 1000) + b), 3), 5),
        "sum": wrap(a + 2147483647),
        "difference": wrap(a - 5),
        "chained": wrap(a + 2),
        "narrow": narrow,
        "of_unsigned": u % 10 + u // 10,
        "product": single(x * y),
        "total": single(x + y),
        "of_int": float(narrow),
    }
    assert {name: repr(getattr(made, name)) for name in expected} == {name: repr(v) for name, v in expected.items()}


@pytest.mark.parametrize(
    "x", [3.4028235677973366e38, 3.4028235677973362e38, 1e300, -1e300, 1e-46, 7.006492321624085e-46, math.nan]
)
def test_rounding_to_real_at_the_ends_of_its_range(x: float) -> None:
    assert repr(values.real(x)) == repr(single(x))


def test_the_text_of_the_compiled_code_keeps_the_calls() -> None:
    unit = compile_text(TEXT, "p.st")
    assert "_v.real(" in unit.python
    assert "_v.modulo(" in unit.python
    names = {name for code in unit.code for name in _names(code)}
    assert not {"modulo", "real"} & names
    assert {"_pack", "_unpack"} <= names


def _names(code: Any) -> set[str]:
    inner = [_names(each) for each in code.co_consts if hasattr(each, "co_names")]
    return set(code.co_names).union(*inner)


def test_an_error_in_an_inlined_operation_has_its_line() -> None:
    made = program(
        "PROGRAM p VAR_INPUT n : DINT; END_VAR VAR_OUTPUT q : DINT; END_VAR\n\n  q := 7 / n MOD 3;\nEND_PROGRAM"
    )
    made.n = 0
    with pytest.raises(values.LogicError, match="division by zero") as found:
        scan(made)
    lines = [entry.lineno for entry in found.traceback if str(entry.path).endswith(".st")]
    assert [line + 1 for line in lines] == [3]
