"""The strict oracle: a value that a device held within the value's age, to the instant, is right; any other is wrong."""

from __future__ import annotations

import pytest

from fieldtwin.run.virtual.age_oracle import KEPT_NS, AgeOracle

EMULATED = frozenset({"d"})


@pytest.mark.parametrize(
    ("raw", "asked_ns", "now_ns", "right"),
    [
        (b"a", 100, 150, True),
        (b"a", 199, 199, True),
        (b"a", 200, 200, True),  # it was requested at the instant of its change
        (b"b", 200, 200, True),
        (b"b", 199, 199, False),  # that came later
        (b"b", 150, 200, True),
        (b"a", 201, 300, False),  # that value had ended
        (b"c", 100, 400, False),  # never
        (b"a", 50, 90, False),  # no value was known at that time
    ],
)
def test_values_held_inside_their_age(raw: bytes, asked_ns: int, now_ns: int, right: bool) -> None:
    oracle = AgeOracle()
    oracle.held("d.x", b"a", 100)
    oracle.held("d.x", b"b", 200)
    oracle.published("d.x", raw, 1, asked_ns, now_ns)
    oracle.check(EMULATED)
    assert (oracle.checked, oracle.wrong_count) == (1, 0 if right else 1)
    assert bool(oracle.wrong) is not right


def test_real_devices_are_not_checked_and_old_values_are_dropped() -> None:
    oracle = AgeOracle()
    oracle.published("real.x", b"a", 1, 0, 10)
    oracle.check(EMULATED)
    assert oracle.checked == 0
    for n in range(1000):
        t_ns = n * KEPT_NS // 100
        oracle.held("d.x", bytes([n % 251]), t_ns)
        oracle.published("d.x", bytes([n % 251]), n, t_ns, t_ns)
        oracle.check(EMULATED)
    assert oracle.wrong_count == 0
    assert len(oracle._held["d.x"].times_ns) < 110
