"""A value that a test sets is the one that the device holds, or it is refused.

Defects: a value beyond an object's range was set without a message and the device held a different one, and `held` gave the
old value right after `set`. A failed ``assert scenario(...)`` printed one line with the characters backslash and n in it.
"""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from device_rig import emulated, started_runner

from fieldtwin.testing.handles import DeviceHandle
from fieldtwin.testing.outcome import ScenarioOutcome
from fieldtwin.testing.runner import FieldtwinRefused, WorkerProcess


@pytest.fixture(scope="module")
def runner() -> Iterator[WorkerProcess]:
    with started_runner() as runner:
        yield runner


@pytest.fixture
def device(runner: WorkerProcess) -> Iterator[DeviceHandle]:
    with emulated(runner, "inclinometer-cia410", unit=9) as device:
        yield device


def test_a_value_beyond_the_range_of_its_object_is_refused(device: DeviceHandle) -> None:
    device.set("slope_long", 1.5)
    with pytest.raises(FieldtwinRefused, match=r"device.slope_long cannot hold 1e\+09; expected -.* to .*int16"):
        device.set("slope_long", 1e9)
    assert device.held("slope_long") == pytest.approx(1.5)
    with (
        pytest.raises(FieldtwinRefused, match="cannot hold"),
        device.fault("out-of-range", register="slope_long", value=1e9),
    ):
        pass


def test_held_gives_the_value_that_was_just_set(device: DeviceHandle) -> None:
    for value in (1.5, -2.25, 3.0):
        device.set("slope_long", value)
        assert device.held("slope_long") == pytest.approx(value)


def test_an_outcome_that_did_not_pass_is_one_line_for_pytest() -> None:
    outcome = ScenarioOutcome("a scenario", "failed", "the level was 2", reproduce="fieldtwin test x")
    assert "\n" not in repr(outcome)
    assert "the level was 2" in repr(outcome)
    assert str(outcome).count("\n") >= 1
