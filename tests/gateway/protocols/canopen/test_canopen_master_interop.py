"""Our master against the `canopen` package's LocalNode, over python-can's `virtual` bus: an independent implementation of CiA
301."""

from __future__ import annotations

import asyncio
import io
import uuid
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import can
import canopen
import pytest
from canopen_master_bus import running
from support import eventually, run

from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.connection import CANConnection, CanConnection, closed_locally
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import SdoAborted, UsageError, VerifyFailed
from fieldtwin.gateway.protocols.canopen.boot import (
    Configuration,
    ExpectedIdentity,
    download_configuration,
    holds_configuration,
    identity_differences,
)
from fieldtwin.gateway.protocols.canopen.configure import (
    Identity,
    configure_tpdo,
    read_identity,
    read_tpdo,
    set_heartbeat_producer,
)
from fieldtwin.gateway.protocols.canopen.eds.concise_dcf import Setting
from fieldtwin.gateway.protocols.canopen.eds.datatypes import DataType, decode
from fieldtwin.gateway.protocols.canopen.eds.dictionary import parse_dictionary
from fieldtwin.gateway.protocols.canopen.emcy import parse_emcy
from fieldtwin.gateway.protocols.canopen.master import CanopenMaster
from fieldtwin.gateway.protocols.canopen.nmt.states import NmtCommand, NmtState, NodeEvent
from fieldtwin.gateway.protocols.canopen.pdo.mapping import PdoMapping
from fieldtwin.gateway.wallclock import WallClock

NODE = 5


def _var(section: str, name: str, kind: int, access: str, default: str = "", mappable: int = 0) -> str:
    lines = [
        f"[{section}]",
        f"ParameterName={name}",
        "ObjectType=0x7",
        f"DataType=0x{kind:04X}",
        f"AccessType={access}",
    ]
    return "\n".join([*lines, f"DefaultValue={default}", f"PDOMapping={mappable}", "", ""])


def _record(index: str, name: str, subs: list[tuple[str, int, str, str]], kind: int = 9) -> str:
    head = f"[{index}]\nParameterName={name}\nObjectType=0x{kind}\nSubNumber={len(subs)}\n\n"
    return head + "".join(_var(f"{index}sub{i}", *sub) for i, sub in enumerate(subs))


EDS = (
    "[DeviceInfo]\nVendorName=Nobody\n\n"
    + _var("1000", "Device type", 7, "ro", "0x2019A")
    + _var("1001", "Error register", 5, "ro", "0")
    + _var("1008", "Device name", 9, "const", "a node with a long name")
    + _var("1014", "COB-ID EMCY", 7, "rw", "$NODEID+0x80")
    + _var("1017", "Producer heartbeat time", 6, "rw", "0")
    + _record("1018", "Identity", [("Max", 5, "const", "4"), *((f"I{i}", 7, "ro", str(i)) for i in range(1, 5))])
    + _record(
        "1800",
        "TPDO1 communication",
        [
            ("Max", 5, "const", "5"),
            ("COB-ID", 7, "rw", "$NODEID+0x40000180"),
            ("Type", 5, "rw", "255"),
            ("Inhibit", 6, "rw", "0"),
            ("Reserved", 5, "rw", "0"),
            ("Event timer", 6, "rw", "0"),
        ],
    )
    + _record(
        "1A00",
        "TPDO1 mapping",
        [("Max", 5, "rw", "1"), ("First", 7, "rw", "0x60100010"), *((f"E{i}", 7, "rw", "0") for i in range(2, 9))],
    )
    + _var("2000", "Note", 9, "rw", "x")
    + _var("6010", "Slope long", 3, "rw", "0", 1)
    + _var("6020", "Slope lateral", 3, "rw", "0", 1)
)


class VirtualEnd(CanConnection):
    """Our end of a python-can bus; its frames come from python-can's thread through the loop."""

    def __init__(self, channel: str) -> None:
        super().__init__(CANConnection(), Endpoint.parse(f"can:virtual/{channel}"))
        self._bus = can.Bus(interface="virtual", channel=channel)
        self._notifier = can.Notifier(self._bus, [self._received], timeout=0.05, loop=asyncio.get_running_loop())

    def _received(self, message: can.Message) -> None:
        self.feed(CanFrame(message.arbitration_id, bytes(message.data), extended=message.is_extended_id))

    async def send(self, frame: CanFrame) -> None:
        self._bus.send(can.Message(arbitration_id=frame.can_id, data=frame.data, is_extended_id=False))

    async def aclose(self) -> None:
        self._notifier.stop()
        self._bus.shutdown()
        self.feed_lost(closed_locally(self.endpoint))


class Pair:
    """The master, its events, and the other side's node."""

    def __init__(self, master: CanopenMaster, node: canopen.LocalNode, events: list[NodeEvent]) -> None:
        self.master, self.node, self.events = master, node, events


@asynccontextmanager
async def pair() -> AsyncIterator[Pair]:
    channel = uuid.uuid4().hex
    network = canopen.Network(can.Bus(interface="virtual", channel=channel))
    network.NOTIFIER_CYCLE = 0.05
    end = VirtualEnd(channel)
    try:
        network.connect()
        node = canopen.LocalNode(NODE, canopen.import_od(_named(EDS), NODE))
        network.add_node(node)
        events: list[NodeEvent] = []
        master = CanopenMaster(end, WallClock(), sdo_timeout_s=2.0, on_event=events.append)
        async with running(master):
            yield Pair(master, node, events)
            node.nmt.stop_heartbeat()
            node.tpdo.stop()
    finally:
        await end.aclose()
        network.disconnect()


def _named(text: str) -> io.StringIO:
    source = io.StringIO(text)
    source.name = "node.eds"
    return source


def test_objects_are_read_and_written_expedited_and_segmented() -> None:
    async def main() -> None:
        async with pair() as p:
            assert await p.master.sdo_upload(NODE, 0x1000, 0) == bytes.fromhex("9A010200")
            assert await p.master.sdo_upload(NODE, 0x1008, 0) == b"a node with a long name"
            for text in (b"abcd", b"abcde", b"seven..", b"fourteen bytes", b"a longer note that takes five segments"):
                await p.master.sdo_download(NODE, 0x2000, 0, text)
                assert p.node.data_store[0x2000][0] == text
                assert await p.master.sdo_upload(NODE, 0x2000, 0) == text
            with pytest.raises(SdoAborted) as caught:
                await p.master.sdo_download(NODE, 0x1000, 0, bytes(4))
            assert caught.value.code == 0x0601_0002
            with pytest.raises(SdoAborted) as caught:
                await p.master.sdo_upload(NODE, 0x1018, 9)
            assert caught.value.code == 0x0609_0011
            assert p.master.counters.sdo_requests == p.master.counters.sdo_replies + 2

    run(main())


def test_a_node_that_knows_no_block_transfer_is_asked_without() -> None:
    async def main() -> None:
        async with pair() as p:
            assert await p.master.sdo_upload(NODE, 0x1008, 0, block=True) == b"a node with a long name"
            await p.master.sdo_download(NODE, 0x2000, 0, b"a longer note that takes five segments", block=True)
            assert p.node.data_store[0x2000][0] == b"a longer note that takes five segments"
            assert p.master.counters.sdo_timeouts == 0

    run(main())


def test_localnode_boots_like_a_node_without_a_configuration_date() -> None:
    async def main() -> None:
        async with pair() as p:
            expected = ExpectedIdentity(device_type=0x2019A, vendor=1, serial=4)
            assert await identity_differences(p.master, NODE, expected) == {}
            assert not await holds_configuration(p.master, NODE, (15000, 1))  # it has no 1020h
            settings = (Setting(0x2000, 0, b"set by its DCF"), Setting(0x1800, 5, b"\x64\0"))
            assert await download_configuration(p.master, NODE, Configuration(settings))
            assert p.node.data_store[0x2000][0] == b"set by its DCF"

    run(main())


def test_identity_heartbeat_and_nmt() -> None:
    async def main() -> None:
        async with pair() as p:
            p.master.add_node(NODE, heartbeat_consumer_ms=2000)
            assert await read_identity(p.master, NODE) == Identity(0x2019A, 1, 2, 3, 4)
            p.node.nmt.send_command(0)  # as after power-on
            await p.master.nmt(NmtCommand.ENTER_PRE_OPERATIONAL, NODE)
            await eventually(lambda: p.node.nmt.state == "PRE-OPERATIONAL")
            await set_heartbeat_producer(p.master, NODE, 50)
            assert p.node.data_store[0x1017][0] == b"\x32\x00"
            await eventually(lambda: p.master.node_state(NODE) is NmtState.PRE_OPERATIONAL)
            await p.master.nmt(NmtCommand.START, NODE)
            await eventually(lambda: p.master.node_state(NODE) is NmtState.OPERATIONAL)
            await p.master.nmt(NmtCommand.STOP, NODE)
            await eventually(lambda: p.master.node_state(NODE) is NmtState.STOPPED)
            p.node.nmt.stop_heartbeat()
            await eventually(lambda: p.events[-1].kind == "heartbeat-lost")

    run(main())


def test_a_tpdo_is_configured_read_back_and_received() -> None:
    async def main() -> None:
        async with pair() as p:
            before = await read_tpdo(p.master, NODE, 1)
            assert (before.cob_id, before.enabled, before.mapping) == (0x185, True, PdoMapping.of([(0x6010, 0, 16)]))
            objects = [(0x6010, 0, 16), (0x6020, 0, 16)]
            mapping = await configure_tpdo(p.master, NODE, 1, objects, 0x1A5, 254, 100, 20)
            after = await read_tpdo(p.master, NODE, 1)
            assert (after.cob_id, after.enabled, after.transmission_type, after.event_ms) == (0x1A5, True, 254, 100)
            assert after.mapping == mapping
            store = p.node.data_store
            assert store[0x1800][1] == bytes.fromhex("A5010040")  # remote frames remain forbidden
            assert store[0x1800][3] == b"\x14\x00"

            seen: list[bytes] = []
            p.master.subscribe_pdo(0x1A5, lambda data, t_ns: seen.append(data))
            p.node.tpdo.read()
            p.node.tpdo[1]["Slope long"].raw = -123
            p.node.tpdo[1]["Slope lateral"].raw = 456
            p.node.tpdo[1].transmit()
            await eventually(lambda: seen != [])
            assert [decode(DataType.INTEGER16, value) for value in mapping.unpack(seen[0])] == [-123, 456]

    run(main())


def test_a_node_that_acknowledges_and_holds_a_different_value_is_reported() -> None:
    async def main() -> None:
        async with pair() as p:
            p.node.add_read_callback(lambda index, subindex, od: 200 if (index, subindex) == (0x1800, 2) else None)
            with pytest.raises(VerifyFailed, match=r"node 5 1800h:02: .*expected FEh; got C8h"):
                await configure_tpdo(p.master, NODE, 1, [(0x6010, 0, 16)], 0x185, 254, 100)

    run(main())


def test_an_impossible_request_is_refused_before_anything_is_sent() -> None:
    async def main() -> None:
        async with pair() as p:
            for number, objects, cob_id, kind in (
                (0, [(0x6010, 0, 16)], 0x185, 254),
                (1, [], 0x185, 254),
                (1, [(0x6010, 0, 64), (0x6020, 0, 1)], 0x185, 254),
                (1, [(0x6010, 0, 16)], 0x605, 254),
                (1, [(0x6010, 0, 16)], 0x185, 256),
            ):
                with pytest.raises(UsageError):
                    await configure_tpdo(p.master, NODE, number, objects, cob_id, kind)
            assert p.master.counters.frames_out == 0

    run(main())


def test_an_emergency_arrives() -> None:
    async def main() -> None:
        async with pair() as p:
            p.node.emcy.send(0x4210, 0x08, b"\x01\x02")
            await eventually(lambda: p.master.counters.emcys == 1)
            emcy = parse_emcy(p.events[0].data)
            assert (emcy.code, emcy.register, emcy.meaning) == (0x4210, 8, "CANopen device temperature")

    run(main())


def test_both_read_the_same_dictionary() -> None:
    theirs, ours = canopen.import_od(_named(EDS), NODE), parse_dictionary(EDS, NODE)
    assert ours.find("TPDO1 communication.COB-ID").default == theirs[0x1800][1].default == 0x40000185
    assert len(ours) == sum(
        1 if isinstance(o, canopen.objectdictionary.ODVariable) else len(o) for o in theirs.values()
    )
