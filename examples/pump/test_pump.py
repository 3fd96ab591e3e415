"""Tests of a PLC program: stepped, with simulated time."""

from __future__ import annotations

import pytest


@pytest.mark.fieldtwin(plc="pump.st")
def test_the_pump_runs_when_the_level_stays_low(plc):
    assert not plc.set(level=10.0).run(1.9)["run"]
    assert plc.run(0.2)["run"]
    assert not plc.set(level=None).scan()["run"]
