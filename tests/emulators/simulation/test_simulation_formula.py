"""Formulas of a simulation: their meaning, their errors, and that any text is either valid or refused."""

from __future__ import annotations

import math
from random import Random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldtwin.emulators.simulation.formula import FUNCTIONS, Formula
from fieldtwin.gateway.core.errors import UsageError


def value(text: str, t: float = 0.0, **names: float) -> float:
    return Formula(text, tuple(names), Random(1))({"t": t, "dt": 0.1, **names})


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("1 + 2 * 3 - 4 / 8", 6.5),
        ("-x ** 2", -9.0),
        ("7 % 3", 1.0),
        ("x if x > 2 and not x > 5 else 0", 3.0),
        ("x == 3 or nan", 1.0),
        ("clamp(x, 0, 2) + max(1, 2) + min(1, 2)", 5.0),
        ("deadband(0.5, 1) + deadband(-2, 1)", -2.0),
        ("hypot(3, 4) + atan2(0, 1) + sqrt(x + 1)", 7.0),
        ("round(2.6) + floor(2.6) + abs(-1)", 6.0),
        ("dt * 10", 1.0),
        ("1 < x < 4", 1.0),
        ("1 < x < 2", 0.0),
        ("x + 500 ms + 2 min", 123.5),
    ],
)
def test_arithmetic_of_formulas(text: str, expected: float) -> None:
    assert value(text, x=3.0) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("text", "t", "expected"),
    [
        ("ramp(10, 20, 5)", 0.0, 10.0),
        ("ramp(10, 20, 5)", 2.5, 15.0),
        ("ramp(10, 20, 5)", 50.0, 20.0),
        ("sine(1, 2, 8)", 2.0, 3.0),
        ("square(0, 5, 4)", 1.9, 0.0),
        ("square(0, 5, 4)", 2.0, 5.0),
        ("triangle(0, 10, 4)", 2.0, 10.0),
        ("triangle(0, 10, 4)", 5.0, 5.0),
        ("sawtooth(0, 8, 4)", 3.0, 6.0),
        ("pulse(2, 1)", 2.0, 1.0),
        ("pulse(2, 1)", 3.0, 0.0),
    ],
)
def test_functions_of_time(text: str, t: float, expected: float) -> None:
    assert value(text, t) == pytest.approx(expected)


@pytest.mark.parametrize(
    "text", ["1 / x", "sqrt(-1)", "log(0)", "x % 0", "9 ** 9 ** 9", "exp(1e9)", "sine(1, 1, 0)", "0 ** -1"]
)
def test_an_impossible_computation_gives_no_value(text: str) -> None:
    assert math.isnan(value(text, x=0.0))


def test_a_name_that_ends_like_a_time_is_a_name() -> None:
    assert value("pump1s + 1 s", pump1s=2.0) == 3.0


def test_noise_is_of_its_seed() -> None:
    def draws(seed: int) -> list[float]:
        formula = Formula("noise(2)", (), Random(seed))
        return [formula({"t": 0.0, "dt": 0.0}) for _ in range(500)]

    assert draws(1) == draws(1) != draws(2)
    assert 1.7 < math.sqrt(sum(d * d for d in draws(3)) / 500) < 2.3


@pytest.mark.parametrize(
    ("text", "message", "hint"),
    [
        ("lewel + 1", "there is no value or function 'lewel'", "level"),
        ("sinus(1)", "no function 'sinus'", "sin"),
        ("ramp(1, 2)", "ramp.. in a formula", ""),
        ("level.real", "there is no value or function 'level.real'", "level"),
        ("[1][0]", "not understood", ""),
        ("'x'", "a text in a formula", ""),
        ("__import__(1)", "no function", ""),
        ("(lambda: 1)()", "not a name", ""),
        ("max(*level)", "not understood", ""),
        ("1 +", "no formula", ""),
        ("", "no formula", ""),
        ("-" * 60 + "1", "nested too deep", ""),
        ("1" * 1001, "too long", ""),
        ("9" * 400, "too large", ""),
    ],
)
def test_an_invalid_formula_is_refused(text: str, message: str, hint: str) -> None:
    with pytest.raises(UsageError, match=message) as e:
        value(text, level=1.0)
    assert hint in str(e.value)


@settings(max_examples=150, deadline=None)
@given(
    st.lists(
        st.sampled_from(
            [
                *FUNCTIONS,
                "x",
                "t",
                "(",
                ")",
                ",",
                "+",
                "-",
                "*",
                "/",
                "**",
                "%",
                " if ",
                " else ",
                "<",
                "1",
                "2.5",
                "not ",
            ]
        ),
        max_size=12,
    ).map("".join)
)
def test_any_text_is_a_formula_or_refused(text: str) -> None:
    try:
        formula = Formula(text, ("x",), Random(1))
    except UsageError:
        return
    assert isinstance(formula({"t": 1.0, "dt": 0.1, "x": 2.0}), float)
