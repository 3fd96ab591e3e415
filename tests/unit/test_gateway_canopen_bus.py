"""A CAN bus of the gateway with an emulated node on the software bus: bring-up, loss, a wrong node, and read-only mode."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from pathlib import Path
from typing import Any

import pytest
from gateway_rig import PROFILES
from support import eventually, run

from fieldtwin.emulators.canopen.dictionary import load_eds
from fieldtwin.emulators.canopen.node import CanopenNode, NodeContext
from fieldtwin.emulators.canopen.serve import serve_node
from fieldtwin.emulators.endpoints.bus_server import SoftBusServer
from fieldtwin.emulators.models.played_objects import PlayedObjects
from fieldtwin.emulators.signals import SignalPlayer, SignalTrack
from fieldtwin.gateway.connections.os_connector import OsConnector
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.concurrency.nursery import Nursery
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import ConnectionLost, NotAllowed
from fieldtwin.gateway.core.files.profile import load_profile
from fieldtwin.gateway.core.files.recording import SignalRow
from fieldtwin.gateway.devices.canopen_device import CanopenDriver
from fieldtwin.gateway.devices.config import BusConfig, CanopenBusConfig, DeviceConfig, Heartbeat, Tpdo
from fieldtwin.gateway.runtime.audit_log import AuditLog
from fieldtwin.gateway.runtime.buses.canopen_bus import CanopenBus
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


def test_a_node_is_identified_configured_and_started_and_its_values_come(tmp_path: Path) -> None:
    async def main() -> None:
        async with rig(tmp_path) as r:
            r.plug_node()
            await eventually(lambda: r.quality("slope_long") == ("good", "none"))
            assert r.tags.current("incl.slope_long", 0).value == 12.34
            assert r.tags.current("incl.slope_lateral", 0).value == -5.0
            assert r.tags.current("incl.serial", 0).value == 1005
            assert r.status.online
            assert r.audit()[:2] == [("sdo", "start-up"), ("nmt", "start-up")]
            first_write = next(f for f in r.frames if f.can_id == SDO_TO_NODE and f.data[0] >> 5 == 1)
            serial_read = next(f for f in r.frames if f.can_id == SDO_TO_NODE and f.data[1:4] == b"\x18\x10\x04")
            assert r.frames.index(serial_read) < r.frames.index(first_write)  # its identity, before anything is written

    run(main())


def test_a_second_node_with_the_id_stays_an_error_of_the_device(tmp_path: Path) -> None:
    """Defect: the error was forgotten at the next bring-up, and a second reply after the next request was not detected."""

    async def main() -> None:
        async with rig(tmp_path) as r:
            other = r.server.attach("another node 5")
            r.plug_node()
            serial = bytes.fromhex("43181004")
            answered = False
            while not answered:
                frame = await other.recv()
                if frame.can_id == SDO_TO_NODE and frame.data[:4] == b"\x40" + serial[1:]:
                    answered = True
                    await other.send(CanFrame(0x580 + NODE, serial + (4711).to_bytes(4, "little")))
            await eventually(lambda: r.status.conflicts == 1)
            await eventually(lambda: r.status.online)
            assert "two replies to one request for 1018h:04" in r.status.conflict
            await other.aclose()

    run(main())


def test_a_second_sync_producer_is_noticed(tmp_path: Path) -> None:
    async def main() -> None:
        async with rig(tmp_path, canopen=CanopenBusConfig(sync_ms=50)) as r:
            other = r.server.attach("another producer")
            r.plug_node()
            await eventually(lambda: r.status.online)
            assert r.bus.sync_watch.verdict == ""
            await other.send(CanFrame(0x80))
            await eventually(lambda: "two producers" in r.bus.sync_watch.verdict)
            await other.aclose()

    run(main())


def test_duplicate_syncs_in_a_cycle_are_detected_by_a_gateway_that_produces_none(tmp_path: Path) -> None:
    """Without --allow-writes the gateway only listens, and the system file still gives the expected SYNC interval."""

    async def main() -> None:
        async with rig(tmp_path, allow_writes=False, canopen=CanopenBusConfig(sync_ms=50)) as r:
            await eventually(lambda: r.bus.connected)
            for number in range(20):
                r.bus.sync_watch.feed(b"", number * 25_000_000)
            assert "SYNC comes every 25 ms, and the communication cycle period is 50 ms" in r.bus.sync_watch.verdict

    run(main())


def test_values_without_a_tpdo_are_read_once(tmp_path: Path) -> None:
    async def main() -> None:
        async with rig(tmp_path, serial="") as r:
            r.plug_node(serial=4711)
            await eventually(lambda: r.quality("slope_long") == ("good", "none"))
            assert r.tags.current("incl.serial", 0).value == 4711

    run(main())


def test_a_node_that_restarts_is_configured_again(tmp_path: Path) -> None:
    async def main() -> None:
        async with rig(tmp_path) as r:
            r.plug_node()
            await eventually(lambda: r.quality("slope_long") == ("good", "none"))
            ups = r.status.bring_ups
            await r.unplug_node()
            r.plug_node()  # boots in PRE-OPERATIONAL with its factory mapping
            await eventually(lambda: r.status.bring_ups > ups)
            await eventually(lambda: r.quality("slope_long") == ("good", "none"))
            assert r.status.boots >= 1

    run(main())


def test_a_lost_heartbeat_makes_the_values_bad_at_once_and_the_node_is_searched(tmp_path: Path) -> None:
    async def main() -> None:
        async with rig(tmp_path) as r:
            r.plug_node()
            await eventually(lambda: r.quality("slope_long") == ("good", "none") and r.status.online)
            await r.unplug_node()
            loop = asyncio.get_running_loop()
            start = loop.time()
            await eventually(lambda: r.quality("slope_long")[0] == "bad")
            assert r.quality("slope_long") == ("bad", "heartbeat lost")
            assert loop.time() - start < 0.35  # well before the values would be stale
            assert not r.status.online
            await eventually(lambda: r.quality("slope_long") == ("bad", "timeout"))  # asked again: no answer
            asked = len([f for f in r.frames if f.can_id == SDO_TO_NODE])
            await eventually(lambda: len([f for f in r.frames if f.can_id == SDO_TO_NODE]) > asked)

    run(main())


def test_another_serial_number_blocks_every_write(tmp_path: Path) -> None:
    async def main() -> None:
        async with rig(tmp_path) as r:
            r.plug_node(serial=7)
            await eventually(lambda: r.quality("slope_long") == ("bad", "wrong device"))
            assert r.status.driver.identity_error == "serial is 7"
            assert "a different node answers" in r.status.error
            assert r.audit() == []
            assert all(f.data[0] >> 5 != 1 for f in r.sent_by_gateway() if f.can_id == SDO_TO_NODE)  # no download
            assert not [f for f in r.frames if f.can_id == 0]  # no NMT
            await r.unplug_node()
            r.plug_node()
            await eventually(lambda: r.quality("slope_long") == ("good", "none"), within_s=10)

    run(main())


def test_without_permission_the_mapping_is_adopted_and_nothing_is_written(tmp_path: Path) -> None:
    async def main() -> None:
        async with rig(tmp_path, allow_writes=False) as r:
            node = r.plug_node()
            await eventually(lambda: r.status.online)
            assert r.quality("slope_long")[0] == "bad"  # no master started it
            operator = r.server.attach("operator")
            await operator.send(CanFrame(0, bytes([1, NODE])))  # the plant's own master does
            await eventually(lambda: r.quality("slope_long") == ("good", "none"))
            assert r.tags.current("incl.slope_long", 0).value == 12.34
            await operator.aclose()
            uploads = [f.data[0] >> 5 for f in r.frames if f.can_id == SDO_TO_NODE]
            assert set(uploads) == {2}  # SDO uploads, and not one download
            assert r.audit() == []
            assert node.counters.nmt_commands == 1  # the operator's
            await r.bus.halt(0.2)
            assert [f.data for f in r.frames if f.can_id == 0] == [bytes([1, NODE])]

    run(main())


def test_a_read_only_plant_reads_tags_over_sdo_that_the_nodes_tpdo_does_not_carry(tmp_path: Path) -> None:
    """Defect: the mapping of `tpdo1` may not be written, so that no message brought the tag, and programs waited for ever."""

    async def main() -> None:
        async with rig(tmp_path, allow_writes=False, serial="", tpdo1=Tpdo(("slope_long", "serial"), 20)) as r:
            r.plug_node()
            await eventually(lambda: r.quality("serial") == ("good", "none"))
            assert r.status.driver.unmapped == ("serial",)
            assert r.quality("slope_long")[0] == "bad"  # the node's TPDO carries it, and no master started the node
            first = r.tags.current("incl.serial", WallClock().monotonic_ns()).t_ns
            await eventually(lambda: r.tags.current("incl.serial", WallClock().monotonic_ns()).t_ns > first)
            uploads = [f.data[0] >> 5 for f in r.frames if f.can_id == SDO_TO_NODE]
            assert set(uploads) == {2}  # SDO uploads, and not one download

    run(main())


def test_on_the_way_out_nodes_that_we_started_are_stopped_even_without_a_record(tmp_path: Path) -> None:
    async def main() -> None:
        async with rig(tmp_path) as r:
            r.plug_node()
            await eventually(lambda: r.quality("slope_long") == ("good", "none") and r.status.online)
            kept, r.bus._audit = r.bus._audit, AuditLog(Path("/dev/full"), WallClock())
            try:
                await r.bus.halt(0.5)
            finally:
                r.bus._audit.close()
                r.bus._audit = kept
            await eventually(lambda: r.quality("slope_long") == ("bad", "not operational"))
            assert bytes([0x80, NODE]) in [f.data for f in r.frames if f.can_id == 0]

    run(main())


def test_a_bus_that_goes_away_is_joined_again(tmp_path: Path) -> None:
    async def main() -> None:
        async with rig(tmp_path) as r:
            r.plug_node()
            await eventually(lambda: r.quality("slope_long") == ("good", "none"))
            port = r.server.bound
            sdo_before = r.bus.totals()["sdo_requests"]
            await r.unplug_node()
            await r.server.aclose()
            await eventually(lambda: not r.bus.connected)
            assert r.quality("slope_long") == ("bad", "unreachable")
            r.server = await SoftBusServer.open(port, 125_000, paced=False)
            try:
                r.plug_node()
                await eventually(lambda: r.quality("slope_long") == ("good", "none"), within_s=8)
                assert r.bus.opens == 2
                assert r.bus.totals()["sdo_requests"] > sdo_before
            finally:
                await r.unplug_node()
                await r.server.aclose()

    run(main())


def test_a_write_to_an_object_that_is_read_only_is_refused(tmp_path: Path) -> None:
    tags = TagTable(WallClock())
    driver = CanopenDriver(DeviceConfig("incl", PROFILE, "can0", NODE), tags, WallClock())
    for tag in ("slope_long", "nothing"):
        with pytest.raises(NotAllowed):
            driver.command(tag, 1)
