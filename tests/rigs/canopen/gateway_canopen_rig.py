"""A gateway's CAN bus with one node on the software bus, for tests of the bus and of what users see of it."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from pathlib import Path
from typing import Any

from gateway_rig import PROFILES

from fieldtwin.emulators.canopen.eds.dictionary import load_eds
from fieldtwin.emulators.canopen.node import CanopenNode, NodeContext
from fieldtwin.emulators.canopen.serve import serve_node
from fieldtwin.emulators.endpoints.can.bus_server import SoftBusServer
from fieldtwin.emulators.models.canopen.played_objects import PlayedObjects
from fieldtwin.emulators.signals import SignalPlayer, SignalTrack
from fieldtwin.gateway.connections.os_connector import OsConnector
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.concurrency.nursery import Nursery
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import ConnectionLost
from fieldtwin.gateway.core.files.profile_file import load_profile
from fieldtwin.gateway.core.files.recording import SignalRow
from fieldtwin.gateway.devices.canopen_device import CanopenDriver
from fieldtwin.gateway.devices.config import BusConfig, CanopenBusConfig, DeviceConfig, Heartbeat, Tpdo
from fieldtwin.gateway.runtime.audit_log import AuditLog
from fieldtwin.gateway.runtime.buses.canopen.canopen_bus import CanopenBus
from fieldtwin.gateway.runtime.tags import TagTable
from fieldtwin.gateway.wallclock import WallClock

PROFILE = load_profile(PROFILES / "inclinometer-cia410.yaml")
NODE = 5
HEARTBEAT = Heartbeat(40, 150)
SDO_TO_NODE, TPDO1 = 0x600 + NODE, 0x180 + NODE


class Rig:
    """The bus, the gateway's side of it, and every frame on it."""

    def __init__(self, server: SoftBusServer, bus: CanopenBus, tags: TagTable, nursery: Nursery, audit: Path) -> None:
        self.server, self.bus, self.tags, self._nursery, self._audit = server, bus, tags, nursery, audit
        self.frames: list[CanFrame] = []
        self._node: asyncio.Task[Any] | None = None

    @property
    def status(self) -> Any:
        return self.bus.nodes[NODE]

    def quality(self, tag: str) -> tuple[str, str]:
        now = self.tags.current(f"incl.{tag}", WallClock().monotonic_ns())
        return str(now.quality), str(now.reason)

    def audit(self) -> list[tuple[str, str]]:
        entries = [json.loads(line) for line in self._audit.read_text(encoding="utf-8").splitlines()]
        return [(e["action"], e["by"]) for e in entries]

    def plug_node(self, serial: int = 1005) -> CanopenNode:
        """A node powers up: slope 12.34 and -5 degrees."""
        dictionary = load_eds(PROFILE.eds_path)  # type: ignore[arg-type]
        track = SignalTrack(("slope_long", "slope_lateral"), [SignalRow(0.0, (12.34, -5.0))])
        player = SignalPlayer(track, WallClock().monotonic_ns())
        source = PlayedObjects(PROFILE.tags.values(), dictionary, player)
        node = CanopenNode(
            dictionary, NODE, NodeContext(source=source, factory={(0x1018, 4): serial.to_bytes(4, "little")})
        )
        connection = self.server.attach("node")
        self._node = self._nursery.start(serve_node(connection, node, WallClock()), "node")
        return node

    async def unplug_node(self) -> None:
        assert self._node is not None
        self._node.cancel()
        with suppress(asyncio.CancelledError):
            await self._node

    async def listen(self) -> None:
        watch = self.server.attach("watch")
        try:
            while True:
                self.frames.append(await watch.recv())
        except ConnectionLost:
            pass  # the bus is closed, so nothing can be observed
        finally:
            await watch.aclose()

    def sent_by_gateway(self) -> list[CanFrame]:
        return [f for f in self.frames if f.can_id in (0, SDO_TO_NODE, 0x80)]


@asynccontextmanager
async def rig(
    tmp_path: Path,
    *,
    allow_writes: bool = True,
    serial: str = "1005",
    canopen: CanopenBusConfig | None = None,
    heartbeat: Heartbeat = HEARTBEAT,
    tpdo1: Tpdo = Tpdo(("slope_long", "slope_lateral"), 20),  # noqa: B008 -- it is frozen
) -> AsyncIterator[Rig]:
    clock = WallClock()
    server = await SoftBusServer.open(Endpoint.parse("can:fieldtwin/127.0.0.1:0"), 125_000, paced=False)
    tags = TagTable(clock)
    config = DeviceConfig(
        "incl", PROFILE, "can0", NODE, expect={"serial": serial} if serial else {}, stale_after_ms=400,
        heartbeat=heartbeat, tpdo1=tpdo1, start=True,
    )  # fmt: skip
    driver = CanopenDriver(config, tags, clock)
    tags.declare(driver.pdo_tags, 400)
    tags.declare(["incl.serial"], None)
    audit = AuditLog(tmp_path / "audit", clock)
    wanted = BusConfig("can0", server.bound, 0.15, 1, canopen=canopen or CanopenBusConfig())
    bus = CanopenBus(wanted, [driver], OsConnector(), clock, tags, audit, allow_writes)
    try:
        async with Nursery() as nursery:
            r = Rig(server, bus, tags, nursery, tmp_path / "audit")
            nursery.start(r.listen(), "watch")
            nursery.start(bus.run(), "bus")
            yield r
    finally:
        await server.aclose()
        audit.close()
