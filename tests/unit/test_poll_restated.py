"""Another period for a poll group while it is read: no interval longer than the longer of both, none shorter than the shorter."""

from __future__ import annotations

from itertools import pairwise

from hypothesis import given, settings
from hypothesis import strategies as st

from gateway.core.clock import NS_PER_MS
from gateway.runtime.poll_schedule import PollSchedule, Rate

PERIODS = st.integers(50, 5000)


def times(schedule: PollSchedule, group: str, begin_ns: int, end_ns: int) -> list[int]:
    """When the group is read, by a bus that is never late."""
    found = []
    now_ns = begin_ns
    while (now_ns := max(now_ns, schedule.due_ns[group])) < end_ns:
        schedule.took(group, now_ns)
        found.append(now_ns)
    return found


def rate(period_ms: int, phase_ms: int = 0) -> Rate:
    return Rate(period_ms * NS_PER_MS, phase_ms % period_ms * NS_PER_MS)


@settings(max_examples=60)
@given(old=PERIODS, new=PERIODS, phase=st.integers(0, 4999), now_ms=st.integers(1, 20_000))
def test_no_poll_is_lost_or_doubled(old: int, new: int, phase: int, now_ms: int) -> None:
    schedule = PollSchedule({"a": rate(old, phase), "b": rate(old)}, ())
    schedule.anchor(0)
    schedule.start(0)
    now_ns, end_ns = now_ms * NS_PER_MS, (now_ms + 40_000) * NS_PER_MS
    read, other = times(schedule, "a", 0, now_ns), times(schedule, "b", 0, now_ns)
    schedule.restate({"a": rate(new), "b": rate(old, 7)}, (), now_ns, there=True)
    read += times(schedule, "a", now_ns, end_ns)
    other += times(schedule, "b", now_ns, end_ns)
    gaps = [(b - a) / NS_PER_MS for a, b in pairwise(read)]
    assert min(gaps[1:]) >= min(old, new)  # the first is read when the device is there, and then at its place
    assert max(gaps) <= max(old, new)
    assert all(b - a == new * NS_PER_MS for a, b in pairwise([t for t in read if t >= now_ns]))
    assert all(b - a == old * NS_PER_MS for a, b in pairwise(other[1:]))  # nothing was said of it
    assert not any(schedule.missed.values())


@settings(max_examples=60)
@given(old=PERIODS, new=PERIODS, phase=st.integers(0, 4999), now_ms=st.integers(6000, 20_000))
def test_a_stated_phase_is_gone_to_within_half_a_period(old: int, new: int, phase: int, now_ms: int) -> None:
    schedule = PollSchedule({"a": rate(old)}, ())
    schedule.anchor(0)
    schedule.start(0)
    now_ns = now_ms * NS_PER_MS
    last_ns = times(schedule, "a", 0, now_ns + 1)[-1]
    schedule.restate({"a": rate(new, phase)}, ("a",), now_ns, there=True)
    due_ns = schedule.due_ns["a"]
    if rate(new, phase) == rate(old):
        assert due_ns == last_ns + old * NS_PER_MS
    else:
        assert due_ns % (new * NS_PER_MS) == phase % new * NS_PER_MS
        assert due_ns - last_ns >= new * NS_PER_MS // 2
        assert due_ns - max(now_ns, last_ns) <= 1.5 * new * NS_PER_MS


def test_what_is_overdue_stays_due_and_what_is_new_is_read_at_once() -> None:
    schedule = PollSchedule({"a": rate(1000)}, ())
    schedule.anchor(0)
    schedule.start(0)
    schedule.took("a", 0)
    schedule.restate({"a": rate(5000), "b": rate(300)}, (), 1_100 * NS_PER_MS, there=True)
    assert schedule.due_ns == {"a": 1000 * NS_PER_MS, "b": 1100 * NS_PER_MS}
    schedule.restate({"b": rate(300)}, (), 1_200 * NS_PER_MS, there=True)
    assert set(schedule.due_ns) == {"b"}
    assert schedule.missed == {"a": 0, "b": 0}


def test_a_device_that_is_away_is_asked_nothing_sooner() -> None:
    schedule = PollSchedule({"a": rate(1000)}, ())
    schedule.anchor(0)
    schedule.restate({"a": rate(500), "b": rate(300)}, (), 100, there=False)
    assert schedule.due_ns == {}
    schedule.start(700 * NS_PER_MS)
    schedule.took("a", 700 * NS_PER_MS)
    assert schedule.due_ns == {"a": 1000 * NS_PER_MS, "b": 700 * NS_PER_MS}
