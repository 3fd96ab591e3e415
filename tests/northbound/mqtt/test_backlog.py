"""The backlog of an MQTT server: order, limits and counters."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from fieldtwin.gateway.core.values import Quality, Reason
from fieldtwin.northbound.mqtt.backlog import SIZE, Backlog, Entry
from fieldtwin.northbound.mqtt.served_tags import ServedTag

TAGS = {name: ServedTag(name, name, "x", f"{name}.x", "String") for name in "ab"}


def entry(device: str, text: str = "") -> Entry:
    return Entry(TAGS[device], text, Quality.GOOD, Reason.NONE, 1)


@given(st.lists(st.tuples(st.sampled_from("ab"), st.text(max_size=20), st.booleans()), max_size=60), st.integers(1, 20))
def test_the_newest_samples_stay_and_each_is_returned_once(steps: list[tuple[str, str, bool]], limit: int) -> None:
    backlog, added, taken = Backlog(limit, 10 * (SIZE + 40)), list[Entry](), list[Entry]()
    for device, text, take in steps:
        added.append(entry(device, text))
        backlog.add(added[-1])
        assert backlog.waiting <= limit
        if take:
            for each in backlog.first(device, 3):
                each.sent = True
                taken.append(each)
    left = [each for device in "ab" for each in backlog.first(device, 1000)]
    assert len(set(map(id, taken + left))) == len(taken) + len(left)
    kept = set(map(id, taken + left))
    lost = [each for each in added if id(each) not in kept]
    assert len(lost) <= backlog.dropped
    assert all(each.number < min((other.number for other in left), default=1 << 60) for each in lost)


def test_bytes_are_limited_as_well() -> None:
    backlog = Backlog(100, 10 * SIZE)
    for n in range(5):
        backlog.add(entry("a", "x" * SIZE))
        assert backlog.waiting == min(n + 1, 2)
    assert backlog.dropped == 3


def test_a_cleared_backlog_is_empty() -> None:
    backlog = Backlog(10, 10_000)
    backlog.add(entry("a"))
    backlog.clear()
    assert (backlog.waiting, backlog.dropped, backlog.first("a", 5)) == (0, 0, [])
