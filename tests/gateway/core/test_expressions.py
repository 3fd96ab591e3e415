"""One language of expressions: its grammar, and that conditions and formulas compute the same numbers."""

from __future__ import annotations

import math
from contextlib import suppress
from random import Random

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from fieldtwin.emulators.simulation.formula import Formula
from fieldtwin.gateway.core.conditions.expression import Expression
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.gateway.core.expressions import OF_NUMBERS, NotUnderstood, Parsed

NAMES = {"x": 2.5, "y": -3.0, "t1s": 7.0}
LEAVES = st.sampled_from([*NAMES, "0", "1", "2.5", "500 ms", "2 min"])


def _grown(inner: st.SearchStrategy[str]) -> st.SearchStrategy[str]:
    calls = [
        st.tuples(*[inner] * count).map(lambda args, name=name: f"{name}({', '.join(args)})")  # type: ignore[misc]
        for name, (count, _) in OF_NUMBERS.items()
    ]
    operators = st.sampled_from(["+", "-", "*", "/", "%", "**"])
    return st.one_of(
        st.tuples(inner, operators, inner).map(lambda parts: f"({' '.join(parts)})"),
        st.tuples(inner, inner, inner).map(lambda parts: f"({parts[0]} if {parts[1]} < {parts[2]} else {parts[0]})"),
        inner.map(lambda text: f"(-{text})"),
        *calls,
    )


@given(st.recursive(LEAVES, _grown, max_leaves=8))
@example("(-atan2(0, (-0)))")
def test_a_condition_and_a_formula_compute_the_same_number(text: str) -> None:
    condition = Expression(text, list(NAMES)).evaluate(lambda function, name: NAMES[name])
    formula = Formula(text, tuple(NAMES), Random(1))({"t": 0.0, "dt": 0.1, **NAMES})
    if math.isnan(formula):
        assert condition is None
    elif condition is not None:  # a part without a result makes a condition unknown, while max(1, nan) is a number
        assert float(condition) == formula


@given(st.text(max_size=60))
def test_any_text_is_parsed_or_refused(text: str) -> None:
    with suppress(UsageError):
        Parsed(text, "expression", "")


@pytest.mark.parametrize("text", ["1.5 s", "x + 1500 ms", "'5 s' == 'x' or 0.025 min", "t1s < 1.5 s"])
def test_times_are_seconds_but_not_in_texts_and_names(text: str) -> None:
    assert Parsed(text, "expression", "").times_s == [1.5]


@pytest.mark.parametrize(("text", "column"), [("x + [1]", 4), ("10 min + x and {}", 15), ("  1.5 s + (lambda: 1)", 11)])
def test_an_error_names_its_column(text: str, column: int) -> None:
    with pytest.raises(NotUnderstood) as caught:
        Parsed(text, "expression", "")
    assert caught.value.at_column == column
