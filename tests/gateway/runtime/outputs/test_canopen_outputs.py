"""A PLC's commands to CANopen nodes: RPDOs, downloads, safe values; polls over SDO and stale values. In virtual time.

The nodes are the emulated drive and I/O module, on a bus in memory.
"""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from canopen_master_bus import MemoryEnd, bus
from modbus_virtual import VirtualLoop, run_virtually
from support import eventually

from fieldtwin.emulators.canopen.node import CanopenNode
from fieldtwin.emulators.canopen.serve import serve_node
from fieldtwin.emulators.models.canopen.emulated_node import emulated_node
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.concurrency.nursery import Nursery
from fieldtwin.gateway.core.connection import ByteConnection, CanConnection
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import FieldtwinError, NotAllowed, ReplyTimeout, Unreachable
from fieldtwin.gateway.core.files.profile_file import load_profile
from fieldtwin.gateway.devices.canopen_config import CanopenBusConfig, CanopenNodeConfig, RpdoConfig
from fieldtwin.gateway.devices.canopen_device import CanopenDriver
from fieldtwin.gateway.devices.canopen_rpdo import usable
from fieldtwin.gateway.devices.config import BusConfig, DeviceConfig, Heartbeat, Tpdo
from fieldtwin.gateway.protocols.canopen.configure import PdoConfig
from fieldtwin.gateway.protocols.canopen.pdo.mapping import PdoMapping
from fieldtwin.gateway.runtime.audit_log import AuditLog
from fieldtwin.gateway.runtime.buses.bus import HeldBack
from fieldtwin.gateway.runtime.buses.canopen.canopen_bus import CanopenBus
from fieldtwin.gateway.runtime.outputs.output import Output
from fieldtwin.gateway.runtime.outputs.outputs import OutputWriter
from fieldtwin.gateway.runtime.tags import TagTable

DEVICES = Path(__file__).parents[4] / "profiles" / "devices"
DRIVE, MODULE = load_profile(DEVICES / "drive-cia402.yaml"), load_profile(DEVICES / "io-cia401.yaml")
WRITABLE = frozenset({"controlword", "mode", "target_velocity"})
NODE = 7
HEARTBEAT = Heartbeat(50, 180)
SPEED = RpdoConfig(("controlword", "target_velocity"))
DRIVEN = DeviceConfig(
    "d", DRIVE, "can0", NODE, heartbeat=HEARTBEAT, start=True, writable=WRITABLE,
    safe={"controlword": 0, "target_velocity": 0}, tpdo1=Tpdo(("statusword", "velocity"), 20),
    canopen=CanopenNodeConfig(rpdo1=SPEED), stale_after_ms=300,
)  # fmt: skip
MODULED = replace(
    DRIVEN, profile=MODULE, tpdo1=Tpdo(("inputs_1",), 20), safe={"outputs_1": 0}, canopen=CanopenNodeConfig(),
    writable=frozenset({"outputs_1", "outputs_2", "analogue_out_1"}),
)  # fmt: skip


class Field:
    """A `Connector` to a bus with one emulated node. `sent` has the gateway's frames with their times."""

    def __init__(self, loop: VirtualLoop, config: DeviceConfig) -> None:
        self.sent: list[CanFrame] = []
        self.node: CanopenNode | None = None
        self.theirs: MemoryEnd | None = None
        self.room: asyncio.Event | None = None
        self._loop, self._config = loop, config
        self._serving: asyncio.Task[None] | None = None

    async def open_can(self, endpoint: Endpoint, bitrate: int) -> CanConnection:
        ours, self.theirs = bus()
        self.room = ours.room
        feed = self.theirs.feed

        def watched(frame: CanFrame) -> None:
            self.sent.append(frame)
            feed(frame)

        self.theirs.feed = watched  # type: ignore[method-assign]
        self.power_on()
        return ours

    async def open_bytes(self, endpoint: Endpoint) -> ByteConnection:
        raise Unreachable("no such wire", where=str(endpoint))

    def power_on(self) -> None:
        assert self.theirs is not None
        made = emulated_node(self._config.profile, NODE, None, self._loop.monotonic_ns())
        self.node = made.node
        self._serving = self._loop.create_task(serve_node(self.theirs, made.node, self._loop))

    async def power_off(self) -> None:
        if self._serving is not None:
            self._serving.cancel()
            with suppress(asyncio.CancelledError):
                await self._serving

    def held(self, index: int, sub: int = 0) -> int:
        assert self.node is not None
        value = self.node.data.get(index, sub)
        return int.from_bytes(value, "little") if isinstance(value, bytes) else int(value)

    @property
    def rpdos(self) -> list[str]:
        """Return RPDOs of the node, in candump's notation."""
        return [str(f) for f in self.sent if f.can_id in (0x207, 0x307, 0x407)]

    @property
    def syncs(self) -> list[CanFrame]:
        return [f for f in self.sent if f.can_id == 0x80]

    @property
    def downloads(self) -> list[CanFrame]:
        return [f for f in self.sent if f.can_id == 0x600 + NODE and f.data[0] >> 5 == 1]

    def downloaded(self, index: int) -> list[bytes]:
        return [
            f.data[4 : 8 - (f.data[0] >> 2 & 3)] for f in self.downloads if f.data[1:3] == index.to_bytes(2, "little")
        ]


class Rig:
    def __init__(self, field: Field, bus_: CanopenBus, writer: OutputWriter, tags: TagTable, audit: Path) -> None:
        self.field, self.bus, self.writer, self.tags, self._audit = field, bus_, writer, tags, audit

    @property
    def status(self) -> Any:
        return self.bus.nodes[NODE]

    def want(self, **values: float) -> None:
        for name, value in values.items():
            self.writer.want(f"d.{name}", value)

    def quality(self, tag: str) -> tuple[str, str]:
        now = self.tags.current(f"d.{tag}", asyncio.get_running_loop().monotonic_ns())  # type: ignore[attr-defined]
        return str(now.quality), str(now.reason)

    def audit(self, action: str = "write") -> list[tuple[object, ...]]:
        entries = [json.loads(line) for line in self._audit.read_text(encoding="utf-8").splitlines()]
        return [(e["tag"], e["by"], e["new"], e["result"]) for e in entries if e["action"] == action]


@asynccontextmanager
async def rig(
    path: Path, config: DeviceConfig = DRIVEN, *, allow_writes: bool = True, sync_ms: int = 0
) -> AsyncIterator[Rig]:
    """A writer that ticks every 10 ms over a running bus; after 0.3 s the node is up."""
    loop = asyncio.get_running_loop()
    assert isinstance(loop, VirtualLoop)
    field, tags, audit = Field(loop, config), TagTable(loop), AuditLog(path / "audit", loop)
    driver = CanopenDriver(config, tags, loop)
    wire = BusConfig("can0", Endpoint.parse("can:x/y"), 0.05, 1, canopen=CanopenBusConfig(sync_ms=sync_ms))
    lost: list[CanopenDriver] = []
    canopen_bus = CanopenBus(wire, [driver], field, loop, tags, audit, allow_writes, lost.append)
    outputs = [Output(f"d.{t}", t, driver, canopen_bus, config.safe.get(t)) for t in sorted(config.writable)]
    writer = OutputWriter(outputs, tags, audit, allow_writes)

    async def ticking() -> None:
        while True:
            while lost:
                writer.forget(lost.pop())
            writer.tick(loop.monotonic_ns())
            await asyncio.sleep(0.01)

    try:
        async with Nursery() as nursery:
            nursery.start(canopen_bus.run(), "bus")
            nursery.start(ticking(), "ticks")
            await asyncio.sleep(0.3)
            yield Rig(field, canopen_bus, writer, tags, path / "audit")
    finally:
        await field.power_off()
        audit.close()


def test_the_commands_of_a_scan_go_in_one_frame_and_only_when_they_change(tmp_path: Path) -> None:
    async def main() -> None:
        async with rig(tmp_path) as r:
            assert r.status.online
            assert r.field.rpdos == []  # no program commanded anything
            r.want(controlword=6, target_velocity=1000)
            await asyncio.sleep(0.3)
            assert r.field.rpdos == ["207#0600E8030000"]
            assert r.tags.current("d.statusword", 0).value & 0x6F == 0x21  # type: ignore[operator]
            r.want(controlword=7)
            await asyncio.sleep(0.05)
            r.want(target_velocity=-1)  # too soon after the last: it waits, and changes made meanwhile go with it
            await asyncio.sleep(0.02)
            r.want(controlword=15)
            await asyncio.sleep(0.3)
            assert r.field.rpdos[1:] == ["207#0700E8030000", "207#0F00FFFFFFFF"]
            assert r.writer.settled
            assert r.writer.rewrites == 0
            assert r.audit()[:4] == [
                ("d.controlword", "plc", 6, "asked"), ("d.target_velocity", "plc", 1000, "asked"),
                ("d.controlword", "plc", 6, "done"), ("d.target_velocity", "plc", 1000, "done"),
            ]  # fmt: skip

    run_virtually(main())


def test_the_drive_runs_and_a_lost_plc_stops_it(tmp_path: Path) -> None:
    async def main() -> None:
        async with rig(tmp_path) as r:
            r.want(mode=3)  # no RPDO carries it, so it is written by SDO
            for word in (6, 7, 15):
                r.want(controlword=word, target_velocity=0)
                await asyncio.sleep(0.15)
            r.want(target_velocity=800)  # the controlword goes with it, unchanged
            await asyncio.sleep(1)
            assert r.field.downloaded(0x6060) == [b"\x03"]
            assert r.tags.current("d.velocity", 0).value == 800
            r.writer.make_safe("the PLC's heartbeat was lost")
            await asyncio.sleep(1)
            assert r.tags.current("d.velocity", 0).value == 0
            assert r.field.rpdos[-1] == "207#000000000000"
            assert ("d.controlword", "safe: the PLC's heartbeat was lost", 0, "done") in r.audit()

    run_virtually(main())


def test_nothing_goes_to_a_node_that_is_not_operational_and_everything_when_it_is_again(tmp_path: Path) -> None:
    async def main() -> None:
        async with rig(tmp_path) as r:
            r.want(controlword=6, target_velocity=5)
            await asyncio.sleep(0.2)
            sent = len(r.field.rpdos)
            await r.status.driver.master.send(CanFrame(0, bytes([0x80, NODE])))  # a change by a different master
            await asyncio.sleep(0.2)
            r.want(controlword=7)
            await asyncio.sleep(0.5)
            assert len(r.field.rpdos) == sent
            assert not r.bus.takes(r.status.driver.config.name, "controlword")
            assert r.writer.failures == 0  # it waits, without futile attempts
            await r.status.driver.master.send(CanFrame(0, bytes([0x01, NODE])))
            await asyncio.sleep(0.2)
            assert r.field.rpdos[sent:] == ["207#070005000000"]
            for command in (0x80, 0x01):  # the state of its outputs meanwhile is unknown
                await r.status.driver.master.send(CanFrame(0, bytes([command, NODE])))
                await asyncio.sleep(0.2)
            assert r.field.rpdos[sent:] == ["207#070005000000"] * 2
            await r.status.driver.master.send(CanFrame(0, bytes([0x80, NODE])))
            await asyncio.sleep(1.9)
            assert r.status.bring_ups == 1
            await asyncio.sleep(0.5)  # it was not started: the gateway brings it up again
            assert r.status.bring_ups == 2
            assert r.field.rpdos[sent:] == ["207#070005000000"] * 3

    run_virtually(main())


@pytest.mark.parametrize("heartbeat", [HEARTBEAT, None])
def test_a_node_that_restarts_is_mapped_and_commanded_again(tmp_path: Path, heartbeat: Heartbeat | None) -> None:
    async def main() -> None:
        async with rig(tmp_path, replace(DRIVEN, heartbeat=heartbeat)) as r:
            r.want(controlword=6, target_velocity=5, mode=3)
            await asyncio.sleep(0.3)
            await r.field.power_off()
            r.field.power_on()
            await asyncio.sleep(1)
            assert r.status.boots >= 1
            assert r.field.rpdos == ["207#060005000000"] * 2
            assert r.field.downloaded(0x6060) == [b"\x03"] * 2
            assert (r.field.held(0x6040), r.field.held(0x60FF)) == (6, 5)
            assert r.writer.rewrites == 0  # the boot-up reported it; no read was needed
            await r.field.power_off()
            await asyncio.sleep(1)  # its heartbeat is missing: no write stays in transit forever
            r.want(controlword=7)
            await asyncio.sleep(1)
            assert not any(o.pending for o in r.writer.outputs)
            r.field.power_on()
            await asyncio.sleep(1)
            assert (r.field.held(0x6040), r.field.held(0x60FF)) == (7, 5)

    run_virtually(main())


def test_a_read_only_plant_is_sent_no_rpdo_and_no_download(tmp_path: Path) -> None:
    async def main() -> None:
        config = replace(DRIVEN, start=False, canopen=CanopenNodeConfig(rpdo1=SPEED, adopt_rpdos=True))
        async with rig(tmp_path, config, allow_writes=False) as r:
            r.want(controlword=6, mode=3)
            r.writer.make_safe("the PLC stopped")
            await asyncio.sleep(0.5)
            assert r.status.online
            assert (r.field.rpdos, r.field.downloads) == ([], [])
            assert {line[:2] for line in r.audit("refuse")} >= {("d.mode", "plc")}
            ends: list[FieldtwinError | None] = []
            driver = r.status.driver
            command = driver.command("mode", 1)
            # The bus refuses the write even without the writer.
            r.bus.write(driver.config.name, [("mode", command)], lambda tag, error: ends.append(error))
            assert isinstance(ends[0], NotAllowed)

    run_virtually(main())


def test_a_group_goes_in_one_frame_per_rpdo_and_ends_at_the_first_failed_write(tmp_path: Path) -> None:
    async def main() -> None:
        async with rig(tmp_path) as r:
            driver, ends = r.status.driver, list[tuple[str, type[Exception]]]()

            def write(**values: int) -> None:
                writes = [(tag, driver.command(tag, value)) for tag, value in values.items()]
                r.bus.write("d", writes, lambda tag, error: ends.append((tag, type(error))))

            write(controlword=6, mode=3, target_velocity=1000)
            await eventually(lambda: len(ends) == 3)
            assert ends == [(tag, type(None)) for tag in ("controlword", "target_velocity", "mode")]
            assert r.field.rpdos == ["207#0600E8030000"]
            assert r.field.downloaded(0x6060) == [b"\x03"]
            await r.field.power_off()
            ends.clear()
            write(mode=1, controlword=7)
            await eventually(lambda: len(ends) == 2)
            assert ends == [("mode", ReplyTimeout), ("controlword", HeldBack)]
            assert len(r.field.rpdos) == 1

    run_virtually(main())


def test_the_bus_knows_which_tags_the_node_sends_by_itself(tmp_path: Path) -> None:
    async def main() -> None:
        async with rig(tmp_path) as r:
            assert r.bus.unrequested("d", "statusword")
            assert not r.bus.unrequested("d", "mode")

    run_virtually(main())


def test_a_different_node_is_not_commanded(tmp_path: Path) -> None:
    async def main() -> None:
        async with rig(tmp_path, replace(DRIVEN, expect={"serial": "4711"})) as r:
            r.want(controlword=6, mode=3)
            await asyncio.sleep(1)
            assert r.status.driver.identity_error
            assert (r.field.rpdos, r.field.downloads) == ([], [])

    run_virtually(main())


def test_a_value_outside_its_limits_is_refused_and_the_rest_of_the_frame_goes(tmp_path: Path) -> None:
    async def main() -> None:
        async with rig(tmp_path) as r:
            r.want(controlword=6, target_velocity=2.0**40)
            await asyncio.sleep(0.3)
            assert r.field.rpdos == ["207#060000000000"]
            assert [line[0] for line in r.audit("refuse")] == ["d.target_velocity"]

    run_virtually(main())


def test_the_nodes_own_rpdos_are_used_if_everything_in_them_is_writable(tmp_path: Path) -> None:
    async def main() -> None:
        config = replace(MODULED, canopen=CanopenNodeConfig(adopt_rpdos=True))
        async with rig(tmp_path, config) as r:
            assert [rpdo.tags for rpdo in r.status.driver.rpdos] == [("outputs_1", "outputs_2")]
            r.want(outputs_1=0xA5, analogue_out_1=2.5)  # RPDO2 also has analogue_out_2, which is not writable
            await asyncio.sleep(0.3)
            assert r.field.rpdos == ["207#A500"]
            assert r.field.downloaded(0x6411) == [(8192).to_bytes(2, "little")]
            assert (r.field.held(0x6200, 1), r.field.held(0x6411, 1)) == (0xA5, 8192)
            r.writer.make_safe("the PLC stopped")
            await asyncio.sleep(0.3)
            assert r.field.rpdos[1:] == ["207#0000"]

    run_virtually(main())


def test_a_synchronous_rpdo_counts_from_the_next_sync_and_is_not_taken_for_lost_before(tmp_path: Path) -> None:
    async def main() -> None:
        config = replace(
            DRIVEN, canopen=CanopenNodeConfig(rpdo1=replace(SPEED, synchronous=True)), poll={"values": 20}
        )  # fmt: skip
        async with rig(tmp_path, config, sync_ms=200) as r:
            assert r.field.held(0x1400, 2) == 1
            heard = len(r.field.syncs)
            await eventually(lambda: len(r.field.syncs) > heard)
            r.want(controlword=6, target_velocity=9)
            await asyncio.sleep(0.1)
            assert (len(r.field.rpdos), r.field.held(0x60FF)) == (1, 0)
            await asyncio.sleep(0.15)
            assert r.field.held(0x60FF) == 9
            await asyncio.sleep(1)
            assert (len(r.field.rpdos), r.writer.rewrites) == (1, 0)

    run_virtually(main())


def test_an_rpdo_is_repeated_and_a_full_bus_is_counted(tmp_path: Path) -> None:
    async def main() -> None:
        config = replace(DRIVEN, canopen=CanopenNodeConfig(rpdo1=replace(SPEED, event_ms=50)))
        async with rig(tmp_path, config) as r:
            await asyncio.sleep(0.5)
            assert r.field.rpdos == []
            r.want(controlword=6, target_velocity=9)
            await asyncio.sleep(0.525)
            assert len(r.field.rpdos) in (10, 11)
            assert set(r.field.rpdos) == {"207#060009000000"}
            assert r.field.room is not None
            r.field.room.clear()
            r.want(controlword=7)
            await asyncio.sleep(0.4)
            assert r.bus.not_produced > 0
            assert r.writer.failures > 0
            r.field.room.set()
            await asyncio.sleep(1.5)
            assert r.field.rpdos[-1] == "207#070009000000"

    run_virtually(main())


def test_a_device_that_holds_a_different_value_is_commanded_again(tmp_path: Path) -> None:
    async def main() -> None:
        async with rig(tmp_path, replace(DRIVEN, poll={"values": 50})) as r:
            r.want(mode=3)
            await asyncio.sleep(0.5)
            await r.status.driver.master.sdo_download(NODE, 0x6060, 0, b"\x01")  # a change by a different client
            await asyncio.sleep(0.5)
            assert r.field.downloaded(0x6060) == [b"\x03", b"\x01", b"\x03"]
            assert r.writer.rewrites == 1

    run_virtually(main())


def test_polled_values_stay_good_and_values_read_at_boot_become_stale(tmp_path: Path) -> None:
    async def main() -> None:
        async with rig(tmp_path, DRIVEN) as r:
            await asyncio.sleep(1)
            assert r.quality("dc_voltage") == ("bad", "stale")  # read once, 300 ms are over
            assert r.quality("statusword") == ("good", "none")  # a TPDO brings it
            assert r.quality("serial") == ("good", "none")  # it cannot change while the node runs
        async with rig(tmp_path, replace(DRIVEN, poll={"values": 100})) as r:
            await asyncio.sleep(1)
            assert r.quality("dc_voltage") == ("good", "none")
            reads = [f for f in r.field.sent if f.can_id == 0x607 and f.data[:4] == bytes.fromhex("40796000")]
            assert 10 <= len(reads) <= 15
            assert not [f for f in r.field.sent[-60:] if f.can_id == 0x607 and f.data[:3] == bytes.fromhex("404160")]

    run_virtually(main())


def test_a_node_without_a_heartbeat_is_lost_when_a_poll_is_not_answered(tmp_path: Path) -> None:
    async def main() -> None:
        config = replace(DRIVEN, heartbeat=None, tpdo1=None, poll={"values": 100}, canopen=CanopenNodeConfig())
        async with rig(tmp_path, config) as r:
            assert r.quality("velocity") == ("good", "none")
            await r.field.power_off()
            await asyncio.sleep(0.5)
            assert (r.status.online, r.quality("velocity")) == (False, ("bad", "timeout"))
            r.field.power_on()
            await asyncio.sleep(3)
            assert (r.status.online, r.quality("velocity")) == (True, ("good", "none"))

    run_virtually(main())


def test_a_boot_up_ends_the_back_off_of_a_lost_node(tmp_path: Path) -> None:
    async def main() -> None:
        async with rig(tmp_path, replace(DRIVEN, backoff_first_s=60.0, backoff_limit_s=60.0, timeout_s=0.02)) as r:
            await r.field.power_off()
            await asyncio.sleep(5)
            asked = len(r.field.sent)
            await asyncio.sleep(20)
            assert (len(r.field.sent), r.status.online) == (asked, False)  # it is left alone
            r.field.power_on()
            await asyncio.sleep(0.3)
            assert r.status.online

    run_virtually(main())


def _rpdo(number: int, *objects: tuple[int, int, int], enabled: bool = True) -> PdoConfig:
    return PdoConfig(number, 0x200 + NODE, enabled, 255, None, PdoMapping.of(objects))


@pytest.mark.parametrize(
    ("held", "writable", "expected"),
    [
        ([_rpdo(1, (0x6040, 0, 16))], {"controlword"}, [1]),
        ([_rpdo(1, (0x6040, 0, 16))], set(), []),  # it is not writable
        ([_rpdo(1, (0x6040, 0, 16), enabled=False)], {"controlword"}, []),
        ([_rpdo(1, (0x6040, 0, 16), (0x6060, 0, 8))], {"controlword"}, []),  # it would write the mode too
        ([_rpdo(1, (0x6040, 0, 16), (0x2345, 0, 8))], {"controlword"}, []),  # nor an unknown object
        ([_rpdo(1, (0x6040, 0, 8))], {"controlword"}, []),  # of a different size
        ([_rpdo(1, (5, 0, 8), (0x6040, 0, 16))], {"controlword"}, [1]),  # a gap
        ([_rpdo(1, (5, 0, 8))], {"controlword"}, []),
        ([_rpdo(1, (0x6040, 0, 16)), _rpdo(2, (0x6040, 0, 16), (0x60FF, 0, 32))], WRITABLE, [2]),
        ([_rpdo(1, (0x6040, 0, 16)), _rpdo(2, (0x60FF, 0, 32))], WRITABLE, [1, 2]),
        ([_rpdo(1, (0x6040, 0, 16), (0x6040, 0, 16))], WRITABLE, []),
    ],
)
def test_only_rpdos_with_writable_objects_are_sent(
    held: list[PdoConfig], writable: set[str], expected: list[int]
) -> None:
    by_object = {tag.object: tag for tag in DRIVE.tags.values()}
    assert [config.number for config in usable(held, by_object, writable)] == expected
    assert usable(held, by_object, writable, writable) == []
