"""The journal of emulated devices' values: numbered, bounded, and bounded for all devices of a process together."""

from __future__ import annotations

import pytest

from fieldtwin.emulators.journal import CAPACITY, LEAST, SHARED, DeviceValue, DeviceValueLog, share_of


def filled(count: int, capacity: int) -> DeviceValueLog:
    journal = DeviceValueLog(capacity)
    for n in range(count):
        journal.note("level", n.to_bytes(2, "big"), 10 * n)
    return journal


def test_equal_values_in_a_row_are_one_entry() -> None:
    journal = DeviceValueLog()
    for tag, raw in (("a", b"1"), ("a", b"1"), ("b", b"1"), ("a", b"2"), ("a", b"1")):
        journal.note(tag, raw, 7)
    assert journal.since(1) == [
        DeviceValue(2, "b", b"1", 7),
        DeviceValue(3, "a", b"2", 7),
        DeviceValue(4, "a", b"1", 7),
    ]
    assert journal.since(4) == []


def test_the_oldest_fall_off_and_are_counted() -> None:
    journal = filled(8, 5)
    assert (journal.number, journal.dropped) == (8, 3)
    assert [h.number for h in journal.since(0)] == [4, 5, 6, 7, 8]
    assert journal.since(7) == [DeviceValue(8, "level", b"\0\7", 70)]


def test_a_lower_capacity_applies_from_now_on() -> None:
    journal = filled(8, 100)
    journal.keep(3)
    assert [h.number for h in journal.since(0)] == [6, 7, 8]
    journal.note("level", b"\0\7", 80)  # as before
    journal.note("level", b"\0\10", 90)
    assert (journal.number, journal.dropped) == (9, 6)
    assert [h.number for h in journal.since(0)] == [7, 8, 9]


@pytest.mark.parametrize("devices", [0, 1, 5, 6, 100, 1000, 5000])
def test_the_devices_of_a_process_share(devices: int) -> None:
    share = share_of(devices)
    assert LEAST <= share <= CAPACITY
    assert share == LEAST or share * devices <= SHARED
