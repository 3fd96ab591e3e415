"""Facts learned about a device's gaps: stored for the next run, for that device only, and printed as a line for its profile."""

from __future__ import annotations

import asyncio
import json
from pathlib import Path

import pytest
from gateway_rig import profile
from hypothesis import given
from hypothesis import strategies as st
from modbus_virtual import run_virtually
from virtual_bus import LINE, VirtualBus, run_bus

from fieldtwin.emulators.modbus.bank import CellSpan, MapBank
from fieldtwin.emulators.modbus.functions.registers import UnitLimits
from fieldtwin.emulators.modbus.unit import ModbusUnit
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import Unreachable
from fieldtwin.gateway.devices.config import BusConfig, DeviceConfig
from fieldtwin.gateway.devices.register_device import RegisterDriver, SensorDriver
from fieldtwin.gateway.runtime.buses.modbus.learnt_gaps import LearntFile, learnt_statuses
from fieldtwin.gateway.runtime.gateway_status import LearntStatus
from fieldtwin.gateway.runtime.tags import TagTable
from fieldtwin.gateway.wallclock import WallClock

TAGS = """
tags:
  a: {at: "holding:0", type: float32}
  b: {at: "holding:5", type: float32}
  c: {at: "holding:8"}
  d: {at: "holding:10"}
  gone: {at: "holding:12"}
"""
HERE = [CellSpan("holding", 0, 2), CellSpan("holding", 5, 6)]
"""2 to 4 are a gap, 7 and 9 exist, 12 does not."""


class Site:
    """One device on a line that can be run repeatedly; `exceptions` are those of the last run."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.profile = profile(TAGS)
        self.unit = 1
        self.endpoint = LINE
        self.limits = UnitLimits()
        self.exceptions = 0
        self.requests = 0
        self.driver: RegisterDriver

    def run(self, seconds: float = 2.05, spans: list[CellSpan] = HERE) -> LearntStatus | None:
        async def main() -> None:
            def make(tags: TagTable) -> list[RegisterDriver]:
                config = DeviceConfig("meter", self.profile, "line", self.unit, poll={"values": 1000})
                self.driver = SensorDriver(config, tags)
                self.file = LearntFile(self.path, [self.driver], {"line": BusConfig("line", self.endpoint)})
                self.file.load()
                return [self.driver]

            async def scenario(v: VirtualBus) -> None:
                await asyncio.sleep(seconds)
                self.exceptions, self.requests = v.bus.totals()["exceptions"], v.bus.totals()["requests"]
                self.file.save()

            await run_bus(make, {self.unit: ModbusUnit(MapBank(spans), limits=self.limits)}, scenario)

        run_virtually(main())
        return learnt_statuses([self.driver]).get("meter")


def learnt(site: Site, spans: list[CellSpan] = HERE) -> LearntStatus:
    """Run the site, and return what it has learnt: something."""
    found = site.run(spans=spans)
    assert found is not None
    return found


@pytest.fixture
def site(tmp_path: Path) -> Site:
    return Site(tmp_path / "learnt.json")


def test_mb_025_a_learnt_gap_is_reported_and_not_read_again(site: Site) -> None:
    assert site.run() == LearntStatus(
        profile="test/device",
        gaps=["holding:2..4"],
        borders=[],
        missing=["gone"],
        line='gaps: ["holding:2..4"]',
    )
    assert site.exceptions > 1
    known = learnt(site)
    assert (site.exceptions, site.requests) == (1, 3 + 2 + 2)  # a missing one is requested once, separately
    assert known.line == 'gaps: ["holding:2..4"]'


def test_mb_025_with_its_line_in_the_profile_nothing_is_left_to_learn(site: Site) -> None:
    site.profile = profile(TAGS.replace('  gone: {at: "holding:12"}\n', ""))
    line = learnt(site).line
    site.profile = profile(f"{line}\n" + TAGS.replace('  gone: {at: "holding:12"}\n', ""))
    assert site.run() is None
    assert (site.exceptions, site.requests) == (0, 2 * 3)
    assert json.loads(site.path.read_text()) != {}  # facts learned with the old profile, until a new fact is learned


@pytest.mark.parametrize("change", ["profile", "unit", "endpoint"])
def test_a_different_device_is_asked_again(site: Site, change: str) -> None:
    site.run()
    asked = site.exceptions
    if change == "profile":
        site.profile = profile(TAGS.replace("float32", "uint32"))
    elif change == "unit":
        site.unit = 2
    else:
        site.endpoint = Endpoint.parse("rtu:/dev/ttyOTHER")
    site.run()
    assert site.exceptions == asked


def test_a_gap_that_answers_again_is_forgotten(site: Site) -> None:
    site.run()
    assert learnt(site, [CellSpan("holding", 0, 2), CellSpan("holding", 5, 8)]).missing == []
    assert site.exceptions == 0


def test_a_damaged_file_counts_as_missing(site: Site) -> None:
    site.run()
    whole = site.path.read_bytes()
    for damaged in (b"", whole[:-3], b"[]", b'{"meter": 1}', whole.replace(b"holding:2", b"nowhere:2"), b"\xff" * 99):
        site.path.write_bytes(damaged)
        site.run()
        assert site.exceptions > 1
        assert site.path.read_bytes() == whole


@given(data=st.binary(max_size=300))
def test_any_content_of_the_file_is_tolerated(data: bytes, tmp_path_factory: pytest.TempPathFactory) -> None:
    path = tmp_path_factory.getbasetemp() / "learnt_fuzz.json"
    path.write_bytes(data)
    driver = SensorDriver(DeviceConfig("meter", profile(TAGS), "line", 1), TagTable(WallClock()))
    LearntFile(path, [driver], {"line": BusConfig("line", LINE)}).load()
    assert driver.learnt.gaps == []


def test_a_disk_that_refuses_is_reported(site: Site, tmp_path: Path) -> None:
    site.run()
    full = LearntFile(tmp_path / "no such folder" / "learnt.json", [site.driver], {"line": BusConfig("line", LINE)})
    with pytest.raises(Unreachable, match="cannot store the learnt gaps"):
        full.save()


def test_a_device_that_accepts_less_than_its_profile_states_keeps_its_limits(site: Site) -> None:
    site.profile = profile('tags:\n  x1..9: {at: "holding:0"}\n')
    site.limits = UnitLimits(read_registers=4)
    known = learnt(site, [CellSpan("holding", 0, 9)])
    assert (known.gaps, known.missing, known.line) == ([], [], "")
    assert known.borders
    assert site.exceptions >= 1
    site.run(spans=[CellSpan("holding", 0, 9)])
    assert site.exceptions == 0
