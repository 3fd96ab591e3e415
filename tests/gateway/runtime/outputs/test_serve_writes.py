"""A client's write to a served tag, from end to end: the output writer's checks, the audit log, the device."""

from __future__ import annotations

import json
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest
from gateway_rig import FieldBus, RunningBus, profile, running_bus, unit
from support import eventually, run

from fieldtwin.emulators.modbus.bank import CellSpan, MapBank
from fieldtwin.gateway.connections.sockets.tcp import TcpConnection
from fieldtwin.gateway.core.concurrency.nursery import Nursery
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import ModbusExceptionReply
from fieldtwin.gateway.devices.config import DeviceConfig
from fieldtwin.gateway.devices.register_device import RegisterDriver, SensorDriver
from fieldtwin.gateway.protocols.modbus.client import ModbusClient
from fieldtwin.gateway.runtime.audit_log import AuditLog
from fieldtwin.gateway.runtime.outputs.output import Output
from fieldtwin.gateway.runtime.outputs.outputs import OutputWriter
from fieldtwin.gateway.runtime.serve import ServeConfig, ServedTag, TagServer
from fieldtwin.gateway.runtime.tags import TagTable
from fieldtwin.gateway.wallclock import WallClock

CLOCK = WallClock()
PROFILE = """
tags:
  level: {at: "holding:0", type: int16, access: rw, range: [-5, 100]}
  other: {at: "holding:1", type: int16, access: rw}
"""


class Rig:
    def __init__(self, bus: RunningBus, cells: MapBank, writer: OutputWriter, client: ModbusClient, path: Path) -> None:
        self.bus, self.cells, self.writer, self.client = bus, cells, writer, client
        self._path = path

    @property
    def audit(self) -> list[dict[str, Any]]:
        return [json.loads(text) for text in self._path.read_text(encoding="ascii").splitlines()]

    async def refused(self, address: int, value: int) -> int:
        with pytest.raises(ModbusExceptionReply) as caught:
            await self.client.write_register(1, address, value & 0xFFFF)
        return caught.value.code


@asynccontextmanager
async def rig(path: Path, *, allow_writes: bool = True, safe: float | None = None) -> AsyncIterator[Rig]:
    cells = MapBank([CellSpan("holding", 0, 2)])
    p = profile(PROFILE)

    def make(tags: TagTable) -> list[RegisterDriver]:
        writable = frozenset({"level"})
        return [SensorDriver(DeviceConfig("d", p, "bus", 1, poll={"values": 20}, writable=writable), tags)]

    async with running_bus(make, FieldBus({1: unit(cells)})) as r:
        audit = AuditLog(path, CLOCK)
        driver = r.bus.devices[0].driver
        outputs = [Output(f"d.{name}", name, driver, r.bus, safe) for name in ("level", "other")]
        writer = OutputWriter(outputs, r.tags, audit, allow_writes)
        served = tuple(ServedTag(f"d.{n}", "holding", i, "int16", write=True) for i, n in enumerate(("level", "other")))
        server = TagServer(
            ServeConfig("hmi", Endpoint.parse("tcp://127.0.0.1:0"), 1, served), r.tags, writer, CLOCK, audit=audit
        )

        async def tick() -> None:
            while True:
                writer.tick(CLOCK.monotonic_ns())
                await CLOCK.sleep_until_ns(CLOCK.monotonic_ns() + 5_000_000)

        async with Nursery() as nursery:
            nursery.start(server.run(), "server")
            nursery.start(tick(), "writer")
            await eventually(lambda: server.front.bound is not None and r.quality("d.level") == ("good", "none"))
            assert server.front.bound is not None
            client = ModbusClient(await TcpConnection.open(server.front.bound), CLOCK, framing="mbap")
            try:
                yield Rig(r, cells, writer, client, path)
            finally:
                await client.aclose()
                audit.close()


def test_a_write_reaches_the_device_and_the_record_once(tmp_path: Path) -> None:
    async def main() -> None:
        async with rig(tmp_path / "a") as r:
            await r.client.write_register(1, 0, 42)
            assert r.cells.peek("holding", 0) == 42
            asked, done = r.audit
            assert (asked["tag"], asked["new"], asked["result"], done["result"]) == ("d.level", 42, "asked", "done")
            assert asked["by"].startswith("127.0.0.1:")
            r.cells.poke("holding", 0, 7)  # a change at the device itself: a client's write is not repeated

            async def read_back() -> bool:
                return (await r.client.read_registers(1, "holding", 0, 1)).registers == (7,)

            await eventually(read_back)
            assert r.cells.peek("holding", 0) == 7
            assert len(r.audit) == 2

    run(main())


def test_limits_permissions_and_spacing_are_observed(tmp_path: Path) -> None:
    async def main() -> None:
        async with rig(tmp_path / "a") as r:
            assert await r.refused(0, 101) == 3  # over the profile's range
            assert await r.refused(1, 1) == 3  # not in the device's `writable`
            await r.client.write_register(1, 0, 1)
            assert await r.refused(0, 2) == 6  # at most ten a second
            assert r.cells.peek("holding", 0) == 1
            assert [e["action"] for e in r.audit] == ["refuse", "refuse", "write", "write", "refuse"]
        async with rig(tmp_path / "b", allow_writes=False) as r:
            assert await r.refused(0, 1) == 3
            assert "read-only" in r.audit[0]["result"]
            assert r.cells.peek("holding", 0) == 0

    run(main())


def test_a_device_that_does_not_answer_is_a_failure_and_nothing_is_written_later(tmp_path: Path) -> None:
    async def main() -> None:
        async with rig(tmp_path / "a") as r:
            device = r.bus.field.units[1].diagnostics
            device.listen_only = True
            assert await r.refused(0, 9) == 4
            device.listen_only = False
            await eventually(lambda: r.bus.quality("d.level") == ("good", "none"))
            before = r.bus.bus.totals()["requests"]
            await eventually(lambda: r.bus.bus.totals()["requests"] > before + 5)
            assert r.cells.peek("holding", 0) == 0

    run(main())


def test_the_safe_state_is_stronger_than_a_client(tmp_path: Path) -> None:
    async def main() -> None:
        async with rig(tmp_path / "a", safe=-1) as r:
            await r.client.write_register(1, 0, 42)
            r.writer.make_safe("a test")
            await eventually(lambda: r.cells.peek("holding", 0) == 0xFFFF)
            assert await r.refused(0, 5) == 6
            r.writer.release()

            async def accepted() -> bool:
                try:
                    await r.client.write_register(1, 0, 5)
                except ModbusExceptionReply:
                    return False
                return True

            await eventually(accepted)
            assert r.cells.peek("holding", 0) == 5

    run(main())


def test_an_unrecordable_write_is_not_made(tmp_path: Path) -> None:
    async def main() -> None:
        async with rig(Path("/dev/full")) as r:
            assert await r.refused(0, 5) == 4
            assert r.cells.peek("holding", 0) == 0

    run(main())
