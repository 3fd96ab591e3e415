"""The state machine of one alarm, compared with a model that is derived from the whole history of its inputs.

The model follows the alarm state transition diagram of ISA-18.2-2016 (IEC 62682 has the same states). It looks back over all
inputs at each step, where the state machine keeps only three bits and a time.
"""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldtwin.gateway.runtime.alarms.state_machine import NEVER_DUE_NS, AlarmState, AlarmStateMachine

Input = tuple[str, bool | int | None]
"""``look`` with a condition, ``acknowledge``, ``shelve`` with a duration, or ``unshelve``."""
INPUTS = st.one_of(
    st.tuples(st.just("look"), st.sampled_from([True, True, False, False, None])),
    st.tuples(st.just("acknowledge"), st.none()),
    st.tuples(st.just("shelve"), st.integers(1, 8)),
    st.tuples(st.just("unshelve"), st.none()),
)


def has_lasted(looks: list[tuple[int, bool | None]], wanted: bool, delay: int) -> bool:
    """Return whether the newest conditions were all `wanted`, and the first of them is at least `delay` old."""
    begun = None
    for t, condition in reversed(looks):
        if condition is not wanted:
            break
        begun = t
    return begun is not None and looks[-1][0] - begun >= delay


def modelled(history: list[tuple[int, Input]], on_delay: int, off_delay: int, needs: bool) -> tuple[str, bool]:
    """Return the state and the delayed condition after `history`, as a table of ISA-18.2's transitions."""
    looks: list[tuple[int, bool | None]] = []
    state, active, shelved_until = "NORM", False, 0

    def unshelved() -> str:
        return ("UNACK" if needs else "ACKED") if active else "NORM"

    for t, (word, value) in history:
        if word == "look":
            assert value is None or isinstance(value, bool)
            looks.append((t, value))
            if has_lasted(looks, not active, off_delay if active else on_delay):
                active = not active
                looks = []  # the time of the next delay begins with the next look
                if active:
                    state = {"NORM": unshelved(), "RTNUN": "UNACK"}.get(state, state)
                else:
                    state = {"UNACK": "RTNUN", "ACKED": "NORM"}.get(state, state)
            if state == "SHLVD" and t >= shelved_until:
                state = unshelved()
        elif word == "acknowledge":
            state = {"UNACK": "ACKED", "RTNUN": "NORM"}.get(state, state)
        elif word == "shelve":
            assert isinstance(value, int)
            state, shelved_until = "SHLVD", t + value
        elif state == "SHLVD":
            state = unshelved()
    return state, active


ISA = {
    AlarmState.NORMAL: "NORM",
    AlarmState.UNACKNOWLEDGED: "UNACK",
    AlarmState.ACKNOWLEDGED: "ACKED",
    AlarmState.RETURNED: "RTNUN",
    AlarmState.SHELVED: "SHLVD",
}


def apply(alarm: AlarmStateMachine, t: int, given: Input) -> None:
    word, value = given
    if word == "look":
        assert value is None or isinstance(value, bool)
        alarm.step(value, t)
    elif word == "acknowledge":
        alarm.acknowledge()
    elif word == "shelve":
        assert isinstance(value, int)
        alarm.shelve(t + value)
    else:
        alarm.unshelve()


@given(st.lists(st.tuples(st.integers(1, 4), INPUTS), max_size=40), st.integers(0, 6), st.integers(0, 6), st.booleans())
def test_the_state_machine_agrees_with_the_transitions_of_isa_18_2(
    steps: list[tuple[int, Input]], on_delay: int, off_delay: int, needs: bool
) -> None:
    alarm = AlarmStateMachine(on_delay, off_delay, needs)
    history: list[tuple[int, Input]] = []
    t = 0
    for passed, one in steps:
        t += passed
        history.append((t, one))
        apply(alarm, t, one)
        assert (ISA[alarm.state], alarm.is_active) == modelled(history, on_delay, off_delay, needs)


@given(
    st.lists(st.tuples(st.integers(1, 4), INPUTS), max_size=30),
    st.sampled_from([True, False, None]),
    st.integers(0, 20),
)
def test_looks_before_the_due_time_change_nothing(
    steps: list[tuple[int, Input]], condition: bool | None, passed: int
) -> None:
    """The gateway skips these looks in virtual time, so they must not matter."""
    alarm, t = AlarmStateMachine(5, 3), 0
    for between, one in steps:
        t += between
        apply(alarm, t, one)
    alarm.step(condition, t)
    before, due = alarm.state, alarm.due_ns
    for later in range(t + 1, min(t + passed, due)):
        alarm.step(condition, later)
        assert (alarm.state, alarm.due_ns) == (before, due)
    if due != NEVER_DUE_NS:
        alarm.step(condition, due)
        assert alarm.due_ns > due


@pytest.mark.parametrize(
    ("conditions", "expected"),
    [
        ([True, True, True], AlarmState.NORMAL),
        ([True, True, True, True], AlarmState.UNACKNOWLEDGED),
        ([True, True, None, True, True, True], AlarmState.NORMAL),
        ([True] * 4 + [None] * 9, AlarmState.UNACKNOWLEDGED),
        ([True] * 4 + [False], AlarmState.RETURNED),
    ],
    ids=[
        "not yet",
        "after the on-delay",
        "an unknown condition restarts the delay",
        "unknown keeps the state",
        "returned",
    ],
)
def test_conditions_once_a_second_with_an_on_delay_of_three_seconds(
    conditions: list[bool | None], expected: AlarmState
) -> None:
    alarm = AlarmStateMachine(on_delay_ns=3)
    for t, condition in enumerate(conditions):
        alarm.step(condition, t)
    assert alarm.state is expected
