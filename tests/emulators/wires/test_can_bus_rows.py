"""The rows of the test-case list that concern the bus: tests/vectors/canopen_bus.toml on the model, then on CANopen nodes."""

from __future__ import annotations

import asyncio
import contextlib
import tomllib
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import pytest
from canopen_rows import parse_frame
from canopen_slave_rig import RICH
from modbus_virtual import VirtualLoop, run_virtually

from fieldtwin.emulators.canopen.eds.dictionary import parse_eds
from fieldtwin.emulators.canopen.node import CanopenNode, NodeContext
from fieldtwin.emulators.canopen.serve import serve_node
from fieldtwin.emulators.endpoints.can.bus_runner import AttachedConnection, BusRunner
from fieldtwin.emulators.endpoints.faulty.can import FaultyCan
from fieldtwin.emulators.faults.engine import WireFaults
from fieldtwin.emulators.faults.frames import Framing
from fieldtwin.emulators.wires.can_bus import CanBus
from fieldtwin.emulators.wires.can_events import Delivery
from fieldtwin.emulators.wires.can_faults import Disturbance, spoil
from fieldtwin.gateway.core.can_error import CanErrorState
from fieldtwin.gateway.core.canframe import CanFrame, pack_record, unpack_record
from fieldtwin.gateway.core.connection import CanConnection
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import Desync, UsageError

BIT_NS = 8000
END = 10**11
ROWS = tomllib.loads((Path(__file__).parents[2] / "vectors" / "canopen_bus.toml").read_text())["row"]
KEYS = {"id", "nodes", "strict", "queue", "spoil", "join", "hear", "say", "told", "end", "errors"}
MS = 10**6
UPLOAD = CanFrame(0x605, bytes.fromhex("4001100000000000"))  # 1001h, the error register
NodeEnd = Callable[[BusRunner, Endpoint], CanConnection]
Happens = Callable[[BusRunner, AttachedConnection], Awaitable[None]]


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row["id"])
@pytest.mark.parametrize("look_bits", [None, 7], ids=["at the end", "often"])
def test_row_of_the_edge_cases_of_a_can_bus(row: dict[str, Any], look_bits: int | None) -> None:
    assert row.keys() <= KEYS
    bus = CanBus(125_000, monitored=not row.get("strict"), queue_frames=row.get("queue", 64))
    node = {name: bus.join(0, name) for name in row["nodes"]}
    for trouble in row.get("spoil", []):
        wanted = trouble.get("frame")
        bus.disturb(
            spoil(
                Disturbance(trouble.get("at_bit"), frozenset(node[n] for n in trouble.get("seen_by", []))),
                match=lambda frame, wanted=wanted: wanted is None or frame.can_id == int(wanted, 16),
                skip=trouble.get("skip", 0),
                times=trouble["times"],
            )
        )
    done: list[Delivery] = []

    def look_until(from_ns: int, to_ns: int) -> None:
        for at_ns in range(from_ns, to_ns, look_bits * BIT_NS) if look_bits else ():
            done.extend(bus.advance(at_ns))

    now_ns = 0
    happenings = [(at, name, frame) for at, name, frame in row["hear"]] + [(at, n, "") for at, n in row.get("join", [])]
    for at, name, what in sorted(happenings, key=lambda h: h[0]):
        look_until(now_ns, at * BIT_NS)
        now_ns = at * BIT_NS
        if not what:
            node[name] = bus.join(now_ns, name)
        else:
            assert bus.submit(node[name], parse_frame(what.lstrip("!")), now_ns) is not what.startswith("!")
    look_until(now_ns, 4000 * BIT_NS)
    done += bus.advance(END)
    names = {number: name for name, number in node.items()}
    said = [[d.frame.t_ns / BIT_NS, "".join(names[n] for n in d.senders), str(d.frame)] for d in done]
    assert said == row["say"]
    if "told" in row:
        assert [[names[n.node], n.state.value] for n in bus.take_notices()] == row["told"]
    for name, (state, tec, rec) in row.get("end", {}).items():
        assert bus.error_state(node[name]) == (CanErrorState(state), tec, rec), name
    if "errors" in row:
        assert bus.error_frames == row["errors"]


# -- length codes of classic frames, and invalid frames --------------------------------------------------------------


@pytest.mark.parametrize("length_code", range(9, 16))
def test_co_064_raw_length_codes_mean_eight_bytes(length_code: int) -> None:
    record = bytearray(pack_record(CanFrame(0x123, bytes(range(8)))))
    record[1] = length_code
    frame, _ = unpack_record(bytes(record))
    assert (frame.dlc, frame.data) == (8, bytes(range(8)))
    record = bytearray(pack_record(CanFrame(0x123, remote=True, dlc=8)))
    record[1] = length_code
    assert unpack_record(bytes(record))[0] == CanFrame(0x123, remote=True, dlc=8)


def test_co_064_a_classic_record_cannot_carry_can_fd() -> None:
    with pytest.raises(UsageError, match="classic CAN frames only"):
        pack_record(CanFrame(0x123, bytes(12), fd=True))
    record = bytearray(pack_record(CanFrame(0x123, bytes(8))))
    record[0] |= 0x10
    with pytest.raises(Desync):
        unpack_record(bytes(record))


# -- CANopen nodes on a bus with errors -----------------------------------------------------------------------------


def on_bus(node_end: NodeEnd, happens: Happens, **options: bool) -> list[str]:
    """Return the frames that another node receives, from the emulated node's boot-up on, with times in ms; `happens` at 100
    ms."""

    async def main() -> list[str]:
        loop = asyncio.get_running_loop()
        assert isinstance(loop, VirtualLoop)
        bus = BusRunner(125_000, **options)
        where = Endpoint.parse("can:fieldtwin/127.0.0.1:1")
        own, tester = node_end(bus, where), bus.attach(where, "tester")
        node = CanopenNode(parse_eds(RICH), 5, NodeContext())
        serving = asyncio.create_task(serve_node(own, node, loop))
        heard: list[str] = []
        start_ns = loop.monotonic_ns()
        await loop.sleep_until_ns(start_ns + 100 * MS)
        await happens(bus, tester)
        await loop.sleep_until_ns(start_ns + 400 * MS)
        while tester.inbound.data_stream:
            frame = await tester.recv()
            if not frame.error:
                heard.append(f"{(frame.t_ns - start_ns) / MS:.1f} {frame}")
        serving.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await serving
        await own.aclose()
        await tester.aclose()
        return heard

    return run_virtually(main())


def plain(bus: BusRunner, where: Endpoint) -> AttachedConnection:
    return bus.attach(where, "node")


def test_co_061_a_node_says_8120h_when_it_is_error_passive_and_takes_it_back() -> None:
    async def happens(bus: BusRunner, tester: AttachedConnection) -> None:
        bus.disturb(spoil(Disturbance(at_bit=20), match=lambda f: f.can_id == 0x585, times=16))
        await tester.send(UPLOAD)

    heard = on_bus(plain, happens)
    assert [line.split()[1] for line in heard] == [
        "705#00", "585#4F01100000000000", "085#2081110000000000", "085#0000000000000000"
    ]  # fmt: skip


def test_co_061_a_node_in_bus_off_is_silent_and_says_8140h_when_it_is_back() -> None:
    async def happens(bus: BusRunner, tester: AttachedConnection) -> None:
        bus.disturb(spoil(Disturbance(at_bit=20), match=lambda f: f.can_id == 0x585, times=32))
        await tester.send(UPLOAD)

    heard = on_bus(plain, happens)
    # 32 attempts of some 40 bits, 128 more of suspension, and 128 * 11 bits: 23 ms.
    # 8120h was queued before bus-off: it is sent with the rest.
    assert [line.split()[1] for line in heard] == [
        "705#00", "585#4F01100000000000", "085#2081110000000000", "085#0000000000000000", "085#4081110000000000"
    ]  # fmt: skip
    assert all(120 < float(line.split()[0]) < 130 for line in heard[1:])


def test_co_062_a_node_whose_receive_queue_overflows_says_8110h() -> None:
    def small(bus: BusRunner, where: Endpoint) -> AttachedConnection:
        return bus.attach(where, "node", max_pending=4)

    async def happens(bus: BusRunner, tester: AttachedConnection) -> None:
        for _ in range(20):  # all at once: no node can receive them in between
            await tester.send(CanFrame(0x000, b"\x01\x10"))

    assert [line.split()[1] for line in on_bus(small, happens, paced=False)] == ["705#00", "085#1081110000000000"]


# -- synchronous TPDOs that miss their window ------------------------------------------------------------------------


def behind_faults(bus: BusRunner, where: Endpoint) -> CanConnection:
    return FaultyCan(bus.attach(where, "node"), WireFaults(Framing.RAW), 5)


@pytest.mark.parametrize("end", [plain, behind_faults])
@pytest.mark.parametrize(("window_us", "in_front", "said"), [
    (0, 4, ["185#05000000"]),
    (5000, 4, ["185#05000000"]),
    (3000, 4, ["085#0081110000000000"]),
    (3000, 3, ["185#05000000"]),
], ids=["no window", "inside", "late", "on the wire when it ends"])  # fmt: skip
def test_co_048_a_synchronous_tpdo_that_waits_beyond_the_window_is_never_sent(
    window_us: int, in_front: int, said: list[str], end: NodeEnd
) -> None:
    """Each frame in front takes about 0.9 ms of the bus, and wins the arbitration against the TPDO."""

    async def happens(bus: BusRunner, tester: AttachedConnection) -> None:
        window = window_us.to_bytes(4, "little").hex()
        for setting in (f"23071000{window}", "2F00180201000000", "2B00200005000000"):
            await tester.send(CanFrame(0x605, bytes.fromhex(setting)))
        await tester.send(CanFrame(0x000, b"\x01\x05"))
        await asyncio.sleep(0.05)
        await tester.send(CanFrame(0x080))
        for _ in range(in_front):
            await tester.send(CanFrame(0x001, bytes(range(8))))

    heard = [line.split()[1] for line in on_bus(end, happens)]
    assert heard[-len(said) :] == said, heard
    assert [frame for frame in heard if frame.startswith("185")] == [frame for frame in said if frame.startswith("185")]
