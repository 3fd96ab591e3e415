"""Scenario conditions are parsed strictly, evaluated without executing code, and unknown if a value is unknown."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldtwin.gateway.core.conditions.expression import Expression
from fieldtwin.gateway.core.errors import UsageError

KNOWN = ["ctd.pressure", "ctd.status", "relay.state"]
NOW: dict[tuple[str, str], Any] = {
    ("value", "ctd.pressure"): 5.5,
    ("quality", "ctd.pressure"): "good",
    ("age", "ctd.pressure"): 1.2,
    ("updates", "ctd.pressure"): 7,
    ("value", "relay.state"): "ACTIVE",
    ("value", "plc.late"): 0.002,
    ("value", "command_pending"): True,
}


def look(function: str, name: str) -> Any:
    return NOW.get((function, name))


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("relay.state == 'ACTIVE'", True),
        ("relay.state != 'ACTIVE'", False),
        ("quality(ctd.pressure) != 'good' or age(ctd.pressure) <= 1.5 s", True),
        ("age(ctd.pressure) <= 1100 ms", False),
        ("age(ctd.pressure) < 0.1 min and ctd.pressure > 5", True),
        ("5 < ctd.pressure < 6", True),
        ("not (ctd.pressure + 1 == 6.5)", False),
        ("-ctd.pressure * 2 == -11", True),
        ("plc.late < 5 ms", True),
        ("command pending and updates(ctd.pressure) == 7", True),
        ("ctd.status > 0", None),  # it has no known value
        ("ctd.status == 0", None),
        ("ctd.status != 0", None),
        ("not (ctd.status > 0)", None),
        ("not (ctd.status + 1 > 0)", None),
        ("-ctd.status < 1 < 2", None),
        ("ctd.pressure / 0 == 1", None),
        ("relay.state > 5", None),
        ("relay.state == 5", False),
        ("relay.state * 3 == relay.state", None),
        ("ctd.status > 0 and ctd.pressure < 0", False),
        ("ctd.status > 0 and ctd.pressure > 0", None),
        ("ctd.status > 0 or ctd.pressure > 0", True),
        ("ctd.status > 0 or ctd.pressure < 0", None),
        ("1 < ctd.status < 0 or 2 < 1 < ctd.status", None),
        ("2 < 1 < ctd.status", False),
        ("'5 s' == '5 s'", True),
        ("true and not false", True),
        ("(1 if ctd.pressure > 5 else 2) == 1", True),
        ("(1 if ctd.status > 5 else 1) == 1", None),
        ("ctd.pressure ** 2 == 30.25 and 7 % 4 == 3 and max(abs(-1), 2) == 2", True),
        ("max(ctd.status, 9) == 9 or sqrt(-1) == 1 or min(relay.state, 1) == 1", None),
    ],
)
def test_values_of_scenario_expressions(text: str, value: bool | None) -> None:
    assert Expression(text, KNOWN).evaluate(look) is value


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("ctd.presure > 1", "did you mean 'ctd.pressure'"),
        ("qualty(ctd.pressure) == 'good'", "did you mean 'quality'"),
        ("ctd.pressure >", "no expression"),
        ("__import__('os').system('true')", "not a name"),
        ("[x for x in ctd.pressure]", "not understood"),
        ("lambda: ctd.pressure", "not understood"),
        ("max(ctd.pressure)", "no function 'max'.*expected 2"),
        ("age(5)", "no function 'age'"),
        ("quality(ctd.pressure, 1)", "no function"),
        ("(" * 300 + "1" + ")" * 300, "expression"),
        ("-" * 200 + "1", "nested too deep"),
        ("1" * 2000, "too long"),
    ],
)
def test_invalid_scenarios_are_refused(text: str, told: str) -> None:
    with pytest.raises(UsageError, match=told):
        Expression(text, KNOWN)


@given(st.text(max_size=60))
@settings(max_examples=300, deadline=None)
def test_any_text_is_an_expression_or_refused(text: str) -> None:
    try:
        expression = Expression(text, KNOWN)
    except UsageError:
        return
    expression.evaluate(look)


def test_an_error_names_its_subject() -> None:
    assert Expression("quality(ctd.pressure) == 'good' and relay.state == 'OFF'", KNOWN).names == [
        "ctd.pressure",
        "relay.state",
    ]
