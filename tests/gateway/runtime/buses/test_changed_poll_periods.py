"""A new period for a poll group while it is read: no interval is longer than the longer period, or shorter than the shorter
one. Then all groups of the bus move to an even distribution, by an eighth of their period at a time."""

from __future__ import annotations

from itertools import pairwise

from hypothesis import given, settings
from hypothesis import strategies as st

from fieldtwin.gateway.core.clock import NS_PER_MS
from fieldtwin.gateway.runtime.buses.poll_schedule import SOONER, PollSchedule, PollSlot, spread

PERIODS = st.integers(50, 5000)


def times(schedule: PollSchedule, group: str, begin_ns: int, end_ns: int) -> list[int]:
    """Return when the group is read, by a bus that is never late."""
    found = []
    now_ns = begin_ns
    while (now_ns := max(now_ns, schedule.due_ns[group])) < end_ns:
        schedule.took(group, now_ns)
        found.append(now_ns)
    return found


def rate(period_ms: int, phase_ms: int = 0) -> PollSlot:
    return PollSlot(period_ms * NS_PER_MS, phase_ms % period_ms * NS_PER_MS)


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
    first = next(n for n, t in enumerate(read) if t >= now_ns)
    # it is read when the device is connected, then at its place
    assert min(gaps[1:first]) >= min(old, new) if first > 1 else True
    assert max(gaps) <= max(old, new)
    on_its_way, there = gaps[first : first + SOONER + 1], gaps[first + SOONER + 1 :]
    assert all(new * 7 / 8 <= gap <= new for gap in on_its_way)
    assert all(gap == new for gap in there)
    assert not there or read[-1] % (new * NS_PER_MS) == 0
    others = [(b - a) / NS_PER_MS for a, b in pairwise(other[1:])]
    assert all(old * 7 / 8 <= gap <= old for gap in others)  # only its place differs
    assert len(others) < 300 or other[-1] % (old * NS_PER_MS) == 7 * NS_PER_MS
    assert not any(schedule.missed.values())


@settings(max_examples=60)
@given(old=PERIODS, new=PERIODS, phase=st.integers(0, 4999), now_ms=st.integers(6000, 20_000))
def test_a_stated_phase_is_reached_within_half_a_period(old: int, new: int, phase: int, now_ms: int) -> None:
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


@settings(max_examples=40)
@given(before=st.lists(PERIODS, min_size=2, max_size=6), after=PERIODS, now_ms=st.integers(1, 20_000))
def test_a_bus_is_spread_as_if_it_had_begun_so(before: list[int], after: int, now_ms: int) -> None:
    """Also those that did not change, because the number of groups that share a period changed."""
    names = [f"g{n}" for n in range(len(before))]
    schedule = PollSchedule(spread(list(zip(names, before, strict=True))), ())
    schedule.anchor(0)
    schedule.start(0)
    for name in names:
        times(schedule, name, 0, now_ms * NS_PER_MS)
    rates = spread(
        [(name, period if n % 2 else after) for n, (name, period) in enumerate(zip(names, before, strict=True))]
    )
    schedule.restate(rates, (), now_ms * NS_PER_MS, there=True)
    for name, (period_ns, phase_ns) in rates.items():
        read = times(schedule, name, now_ms * NS_PER_MS, now_ms * NS_PER_MS + (SOONER + 3) * period_ns)
        assert read[-1] % period_ns == phase_ns
    assert not any(schedule.missed.values())


def test_a_late_group_is_not_polled_earlier() -> None:
    schedule = PollSchedule({"a": rate(800)}, ())
    schedule.anchor(0)
    schedule.start(0)
    schedule.took("a", 0)
    schedule.restate({"a": rate(800, 400)}, (), 1, there=True)
    schedule.took("a", 1000 * NS_PER_MS)  # it was due at 800 ms
    assert schedule.due_ns["a"] == 1600 * NS_PER_MS
    schedule.took("a", 1600 * NS_PER_MS)
    assert schedule.due_ns["a"] == 2300 * NS_PER_MS
    schedule.stop()
    schedule.start(2350 * NS_PER_MS)  # it was disconnected: its earlier place does not count
    schedule.took("a", 2350 * NS_PER_MS)
    assert schedule.due_ns["a"] == 2800 * NS_PER_MS


def test_an_overdue_group_stays_due_and_a_new_one_is_read_at_once() -> None:
    schedule = PollSchedule({"a": rate(1000)}, ())
    schedule.anchor(0)
    schedule.start(0)
    schedule.took("a", 0)
    schedule.restate({"a": rate(5000), "b": rate(300)}, (), 1_100 * NS_PER_MS, there=True)
    assert schedule.due_ns == {"a": 1000 * NS_PER_MS, "b": 1100 * NS_PER_MS}
    schedule.restate({"b": rate(300)}, (), 1_200 * NS_PER_MS, there=True)
    assert set(schedule.due_ns) == {"b"}
    assert schedule.missed == {"a": 0, "b": 0}


def test_a_disconnected_device_is_not_asked_earlier() -> None:
    schedule = PollSchedule({"a": rate(1000)}, ())
    schedule.anchor(0)
    schedule.restate({"a": rate(500), "b": rate(300)}, (), 100, there=False)
    assert schedule.due_ns == {}
    schedule.start(700 * NS_PER_MS)
    schedule.took("a", 700 * NS_PER_MS)
    assert schedule.due_ns == {"a": 1000 * NS_PER_MS, "b": 700 * NS_PER_MS}
