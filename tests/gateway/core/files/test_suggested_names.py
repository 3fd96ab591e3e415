"""Suggestions for misspelt names."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from fieldtwin.gateway.core.files.nearest import did_you_mean, nearest

NAMES = st.lists(st.text("abcdeXYZ_.", min_size=1, max_size=8), max_size=8, unique_by=str.lower)


@given(NAMES, st.text("abcdeXYZ_.", min_size=1, max_size=8), st.integers(1, 4))
def test_suggestions_are_known_names_and_a_known_name_in_another_case_is_the_first(
    known: list[str], name: str, most: int
) -> None:
    near = nearest(name, known, most)
    assert set(near) <= set(known)
    assert len(near) == len(set(near)) <= most
    same = [k for k in known if k.lower() == name.lower()]
    assert near[:1] == same or not same


def test_a_hint_quotes_the_name_as_it_is_written() -> None:
    assert did_you_mean("SETPINT", ["Setpoint", "other"]) == "did you mean 'Setpoint'?"
    assert did_you_mean("x", ["Setpoint"], "see the manual") == "see the manual"


def test_a_longer_name_with_the_whole_name_comes_before_a_similar_one() -> None:
    assert did_you_mean("fan", ["supply_fan", "panel"]) == "did you mean 'supply_fan'?"
    assert did_you_mean("fan.frequency", ["panel.frequency", "supply_fan.frequency"]) == (
        "did you mean 'supply_fan.frequency'?"
    )


def test_of_equally_similar_names_the_first_is_suggested() -> None:
    assert nearest("outputs", ["outputs_1", "outputs_2"]) == ["outputs_1"]
