"""A whole bus on a serial port that disappears, returns, or is held by a different program: real ptys, no manual restart."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

from gateway_rig import profile
from support import eventually, run

from fieldtwin.emulators.endpoints.modbus_server import serve_rtu
from fieldtwin.emulators.endpoints.pty import PtyEnd
from fieldtwin.emulators.modbus.bank import CellSpan, MapBank
from fieldtwin.emulators.modbus.rtu.line import RtuServer
from fieldtwin.emulators.modbus.unit import ModbusUnit
from fieldtwin.gateway.connections.os_connector import OsConnector
from fieldtwin.gateway.connections.serial.line import SerialConnection
from fieldtwin.gateway.core.concurrency.nursery import Nursery
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.devices.config import BusConfig, DeviceConfig
from fieldtwin.gateway.devices.register_device import RegisterDriver, SensorDriver
from fieldtwin.gateway.runtime.buses.modbus.modbus_bus import ModbusBus
from fieldtwin.gateway.runtime.tags import TagTable
from fieldtwin.gateway.wallclock import WallClock

CLOCK = WallClock()
PROFILE = "tags:\n  level: {at: 'holding:0', poll: fast}\n"


def plant(path: Path) -> Endpoint:
    return Endpoint.parse(f"rtu:{path}/line?baudrate=115200&frame=8N1")


@asynccontextmanager
async def plugged(path: Path, cells: MapBank) -> AsyncIterator[None]:
    """A unit on an adapter, while that is plugged in."""
    end = await PtyEnd.open(path / "line", plant(path), None)
    task = asyncio.create_task(serve_rtu(end, RtuServer({1: ModbusUnit(cells)}), CLOCK))
    try:
        yield
    finally:
        await end.aclose()
        await task


class Watched:
    """A bus with one device, and the state of its tag."""

    def __init__(self, path: Path) -> None:
        self.tags = TagTable(CLOCK)
        config = DeviceConfig("d", profile(PROFILE), "line", 1, poll={"fast": 20}, stale_after_ms=400)
        driver: RegisterDriver = SensorDriver(config, self.tags)
        self.tags.declare(driver.tag_names, driver.config.stale_after_ms)
        self.bus = ModbusBus(
            BusConfig("line", plant(path), 0.1, 1), [driver], OsConnector(), CLOCK, self.tags, lambda d: None
        )

    def says(self, value: object, quality: str, reason: str = "none") -> bool:
        now = self.tags.current("d.level", CLOCK.monotonic_ns())
        return (now.value, str(now.quality), str(now.reason)) == (value, quality, reason)


def test_mb_066_an_adapter_that_is_plugged_in_again_is_used_again(tmp_path: Path) -> None:
    async def main() -> None:
        watched, cells = Watched(tmp_path), MapBank([CellSpan("holding", 0, 1)])
        cells.poke("holding", 0, 7)
        async with Nursery() as nursery:
            nursery.start(watched.bus.run(), "bus")
            for turn in (7, 8):
                cells.poke("holding", 0, turn)
                async with plugged(tmp_path, cells):
                    await eventually(lambda turn=turn: watched.says(turn, "good"), what=f"a value in turn {turn}")
                await eventually(lambda: not watched.bus.connected)
                assert watched.says(turn, "bad", "unreachable")
            assert watched.bus.opens == 2

    run(main())


def test_mb_067_a_port_in_use_is_reported_and_tried_again(tmp_path: Path) -> None:
    async def main() -> None:
        watched, cells = Watched(tmp_path), MapBank([CellSpan("holding", 0, 1)])
        cells.poke("holding", 0, 7)
        async with plugged(tmp_path, cells):
            holder = await SerialConnection.open(plant(tmp_path))
            async with Nursery() as nursery:
                nursery.start(watched.bus.run(), "bus")
                await eventually(lambda: "another program" in watched.bus.error)
                assert watched.says(None, "bad", "unreachable")
                await holder.aclose()
                await eventually(lambda: watched.says(7, "good"))

    run(main())
