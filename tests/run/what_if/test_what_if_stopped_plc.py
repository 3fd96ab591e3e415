"""What-if with a PLC that stops, and requirements on unknown values: neither may be met."""

from __future__ import annotations

from pathlib import Path

from tank_plant import DIVIDES_BY_ZERO, write_plant

from fieldtwin.run.what_if.fork import Fork, answer
from fieldtwin.run.what_if.plan import WhatIfPlan
from fieldtwin.run.what_if.state import KnownState


def plan(name: str, *require: str) -> WhatIfPlan:
    return WhatIfPlan(name, require=require)


def test_a_plan_in_which_the_plc_stops_or_nothing_is_known_is_not_met(tmp_path: Path) -> None:
    """Defect: ``not pump.fault`` was met by a PLC that divided by zero in its first scan."""
    (tmp_path / "pump.st").write_text(DIVIDES_BY_ZERO)
    write_plant(tmp_path)
    fork = Fork(str(tmp_path / "plant.yaml"), KnownState(), 10.0)
    stopped = answer(fork, plan("divides by zero", "not pump.fault"))
    assert not stopped.met
    assert "pump.st:9" in stopped.error
    (tmp_path / "pump.st").write_text(DIVIDES_BY_ZERO.replace("3 / zero > 3", "level < 0"))
    assert answer(fork, plan("runs", "not pump.fault", "not (sensor.level > 100)")).met
    assert not answer(fork, plan("unknown", "not (sensor.level / 0 > 100)")).met
