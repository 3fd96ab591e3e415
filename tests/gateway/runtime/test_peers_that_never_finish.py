"""Peers that send one byte just before each timeout, or frames without an end: each read from a peer ends within a stated
limit.

Defects: an SDO upload of one byte per segment blocked the client for up to twelve days; a flood of foreign Modbus TCP frames
could keep an exchange open as long as it lasted; and 64 silent clients of a control channel with a token locked its owner out.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
from collections.abc import AsyncIterator, Awaitable, Callable
from pathlib import Path

import pytest
from bridge_rig import read_adu, rig, take
from canopen_master_bus import LoopClock, bus, run_virtual, running
from gateway_rig import FieldBus, profile, running_bus, unit, wire
from modbus_virtual import run_virtually
from support import eventually, run
from two_poll_groups import TWO_GROUPS, bank, config

from fieldtwin.emulators.endpoints.can import bus_server
from fieldtwin.emulators.endpoints.can.bus_hello import BusHello
from fieldtwin.emulators.endpoints.can.bus_server import SoftBusServer
from fieldtwin.gateway.connections.sockets.tcp import TcpConnection
from fieldtwin.gateway.core import control
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.connection import ByteConnection, TCPConnection
from fieldtwin.gateway.core.control import ControlClient, ControlServer
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import ConnectionLost, FieldtwinError, ReplyTimeout
from fieldtwin.gateway.devices.register_device import RegisterDriver, SensorDriver
from fieldtwin.gateway.protocols.canopen.master import CanopenMaster
from fieldtwin.gateway.protocols.canopen.sdo.block import SdoBlockDownload, SdoBlockUpload
from fieldtwin.gateway.protocols.canopen.sdo.transfers import (
    WHOLE_NS_PER_BYTE,
    WHOLE_TIMEOUTS,
    Failed,
    SdoDownload,
    SdoTransfer,
    SdoUpload,
    SendFrame,
    WaitForFrame,
)
from fieldtwin.gateway.protocols.modbus.client import ModbusClient
from fieldtwin.gateway.runtime.bridge import tcp as bridge_tcp
from fieldtwin.gateway.runtime.tags import TagTable
from fieldtwin.gateway.wallclock import WallClock
from fieldtwin.service import metrics_server
from fieldtwin.service.metrics_server import MetricsServer

NS = 1_000_000_000

# -- Modbus client -----------------------------------------------------------------------------------------------------


class Babbler(FieldBus):
    """Unit 2 answers until `babbles` is set. Then it sends `piece` every `every_s` seconds, and answers nothing."""

    def __init__(self, piece: bytes, every_s: float) -> None:
        super().__init__({1: unit(bank()), 2: unit(bank())})
        self.babbles = asyncio.Event()
        self.quiet = False
        self._piece, self._every_s = piece, every_s

    async def _serve(self, far: ByteConnection, endpoint: Endpoint) -> None:
        near, inner = wire(endpoint)
        tasks = [
            asyncio.ensure_future(job)
            for job in (super()._serve(inner, endpoint), self._back(near, far), self._say(far))
        ]
        try:
            with contextlib.suppress(ConnectionLost):
                while True:
                    data = await far.read()
                    if data[0] != 2 or not self.babbles.is_set() or self.quiet:
                        await near.write(data)
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)

    async def _back(self, near: ByteConnection, far: ByteConnection) -> None:
        while True:
            await far.write(await near.read())

    async def _say(self, far: ByteConnection) -> None:
        await self.babbles.wait()
        while not self.quiet:
            await far.write(self._piece)
            await asyncio.sleep(self._every_s)


def drivers(tags: TagTable) -> list[RegisterDriver]:
    p = profile(TWO_GROUPS)
    return [SensorDriver(config("honest", p, 1), tags), SensorDriver(config("hostile", p, 2), tags)]


@pytest.mark.parametrize(
    "piece", [b"\x02", bytes.fromhex("09 03 02 0000 5985")], ids=["a byte", "a frame of another unit"]
)
def test_a_unit_that_never_falls_silent_costs_the_other_units_of_its_line_nothing(piece: bytes) -> None:
    """The timeout is 100 ms, and the unit sends every 90 ms; the line has its silences."""

    async def main() -> None:
        field = Babbler(piece, 0.09)
        async with running_bus(drivers, field, timeout_s=0.1) as r:
            await eventually(lambda: r.quality("honest.fast") == r.quality("hostile.fast") == ("good", "none"))
            field.babbles.set()
            await eventually(lambda: r.quality("hostile.fast")[0] == "bad")
            before, bad = len(field.heard), 0

            def polled() -> bool:
                nonlocal bad
                bad += r.quality("honest.fast")[0] != "good"
                return sum(adu[0] == 1 for adu in field.heard[before:]) >= 60

            await eventually(polled, 15)
            assert bad == 0
            assert r.quality("hostile.fast")[0] == "bad"

    run(main())


def test_a_line_that_is_never_silent_is_bad_and_good_again_when_it_ends() -> None:
    """Frames without an end, every millisecond: nothing can be sent, and each poll reports that within its limit."""

    async def main() -> None:
        field = Babbler(bytes.fromhex("09 03 02 0000 5985"), 0.001)
        async with running_bus(drivers, field, timeout_s=0.1) as r:
            await eventually(lambda: r.quality("honest.fast") == ("good", "none"))
            field.babbles.set()
            await eventually(lambda: r.quality("honest.fast")[0] == r.quality("hostile.fast")[0] == "bad", 10)
            field.quiet = True
            await eventually(lambda: r.quality("honest.fast") == r.quality("hostile.fast") == ("good", "none"), 10)

    run(main())


class Endless(ByteConnection):
    """A connection that always has data to read."""

    def __init__(self, endpoint: Endpoint, data: bytes) -> None:
        super().__init__(TCPConnection(), endpoint)
        self._data = data

    async def write(self, data: bytes) -> None:
        self.feed(self._data)

    def on_room(self) -> None:
        asyncio.get_running_loop().call_soon(self._more)

    def _more(self) -> None:
        if self.lost is None and not self.inbound.data_stream:
            self.feed(self._data)

    async def aclose(self) -> None:
        self.feed_lost(ConnectionLost("closed"))


@pytest.mark.parametrize("framing", ["mbap", "rtu", "ascii"])
def test_a_flood_of_other_frames_does_not_prolong_an_exchange(framing: str) -> None:
    """The flood never pauses, so time is only checked when bytes arrive."""
    frames = {
        "mbap": bytes.fromhex("7777 0000 0005 01 03 02 0001"),
        "rtu": bytes.fromhex("09 03 02 0000 5985"),
        "ascii": b":0903020000F2\r\n",
    }

    async def main() -> None:
        endpoint = Endpoint.parse("tcp://127.0.0.1:1")
        client = ModbusClient(Endless(endpoint, frames[framing] * 8), WallClock(), framing=framing, timeout_s=0.2)  # type: ignore[arg-type]
        with pytest.raises(FieldtwinError):
            await client.read_registers(1, "holding", 0, 1)
        await client.aclose()

    run(main(), 10)


def test_a_reply_that_drips_ends_at_the_timeout_of_its_request() -> None:
    """One byte every 0.9 of a timeout: the timeout counts from the request, not from the last byte."""

    async def main() -> None:
        loop = asyncio.get_running_loop()
        endpoint = Endpoint.parse("tcp://127.0.0.1:1")
        near, far = wire(endpoint)
        client = ModbusClient(near, loop, framing="mbap", timeout_s=1.0)  # type: ignore[arg-type]

        async def drip() -> None:
            request = await far.read()
            for byte in request[:2] + bytes.fromhex("0000 0005 01 03 02 0001"):
                await asyncio.sleep(0.9)
                await far.write(bytes([byte]))

        peer = loop.create_task(drip())
        began = loop.time()
        with pytest.raises(ReplyTimeout):
            await client.read_registers(1, "holding", 0, 1)
        assert loop.time() - began == pytest.approx(1.0)
        peer.cancel()
        await asyncio.gather(peer, return_exceptions=True)
        await client.aclose()

    run_virtually(main())


# -- Modbus TCP server: tag server and bridge --------------------------------------------------------------------------


async def dripping(write: Callable[[bytes], Awaitable[None]], data: bytes, every_s: float) -> None:
    with contextlib.suppress(ConnectionLost, OSError):
        while True:
            for byte in data:
                await write(bytes([byte]))
                await asyncio.sleep(every_s)


def test_a_request_that_drips_ends_its_connection_and_other_clients_are_served(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bridge_tcp, "REQUEST_WITHIN_S", 0.5)

    async def main() -> None:
        async with rig(tmp_path) as r, r.raw() as hostile, r.client() as honest:
            drip = asyncio.ensure_future(dripping(hostile.write, bytes(4) + b"\0\xfd" + bytes(250), 0.05))
            counters = r.bridge.front.counters
            while not counters.unfinished:
                reply = await honest.read_registers(1, "holding", 0, 2)
                assert reply.registers == (100, 101)
            with pytest.raises(ConnectionLost):
                await hostile.read()
            await drip
            assert counters.unfinished == 1
            assert r.bridge.front.status().counters["unfinished"] == 1

    run(main())


def test_a_client_that_is_only_slow_between_its_requests_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bridge_tcp, "REQUEST_WITHIN_S", 0.2)

    async def main() -> None:
        async with rig(tmp_path) as r, r.raw() as client:
            adu = read_adu(1, 1, 0, 1)
            for n in range(3):
                await client.write(adu[:5])
                await client.write(adu[5:])
                assert (await take(client, 11))[-2:] == (100).to_bytes(2)
                await asyncio.sleep(0.25 if n < 2 else 0)  # longer than a request may take to arrive
            assert r.bridge.front.counters.unfinished == 0

    run(main())


# -- control channel ---------------------------------------------------------------------------------------------------


async def echo(args: dict[str, object]) -> object:
    return args


@contextlib.asynccontextmanager
async def control_port(token: str) -> AsyncIterator[int]:
    server = ControlServer({"echo": echo}, token)
    try:
        yield await server.listen_tcp("127.0.0.1", 0)
    finally:
        await server.aclose()


@pytest.mark.parametrize("piece", [b"", b"{"], ids=["says nothing", "drips"])
def test_silent_clients_cannot_occupy_the_places_of_a_control_channel(
    monkeypatch: pytest.MonkeyPatch, piece: bytes
) -> None:
    monkeypatch.setattr(control, "LINE_WITHIN_S", 0.5)
    monkeypatch.setattr(control, "MAX_CLIENTS", 8)

    async def main() -> None:
        async with control_port("secret") as port:
            strangers = [await asyncio.open_connection("127.0.0.1", port) for _ in range(8)]

            async def write(writer: asyncio.StreamWriter, data: bytes) -> None:
                writer.write(data)
                await writer.drain()

            drips = [
                asyncio.ensure_future(dripping(lambda data, w=writer: write(w, data), piece, 0.05))  # type: ignore[misc]
                for _, writer in strangers
                if piece
            ]

            async def answered() -> bool:
                client = await ControlClient.connect_tcp("127.0.0.1", port, "secret")
                try:
                    return bool(await client.call("echo", a=1) == {"a": 1})
                except ConnectionLost:
                    return False
                finally:
                    await client.aclose()

            await eventually(answered)
            for reader, _ in strangers:
                with contextlib.suppress(ConnectionError):
                    assert await asyncio.wait_for(reader.read(), 5) == b""
            for drip in drips:
                drip.cancel()
            await asyncio.gather(*drips, return_exceptions=True)
            for _, writer in strangers:
                writer.close()
                with contextlib.suppress(OSError):
                    await writer.wait_closed()

    run(main())


def test_an_owner_that_is_silent_between_its_requests_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(control, "LINE_WITHIN_S", 0.1)

    async def main() -> None:
        async with control_port("secret") as port:
            client = await ControlClient.connect_tcp("127.0.0.1", port, "secret")
            assert await client.call("echo", a=1) == {"a": 1}
            await asyncio.sleep(0.3)  # longer than a line may take
            assert await client.call("echo", a=2) == {"a": 2}
            await client.aclose()

    run(main())


def test_a_slow_scrape_is_ended_and_others_are_served(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(metrics_server, "PATIENCE_S", 0.5)
    monkeypatch.setattr(metrics_server, "MOST_CLIENTS", 4)

    async def main() -> None:
        server = MetricsServer(lambda: "one 1\n")
        url = await server.open("127.0.0.1", 0)
        place = Endpoint.parse(f"tcp://{url.split('/')[2]}")
        hostile = [await TcpConnection.open(place) for _ in range(4)]
        drips = [asyncio.ensure_future(dripping(client.write, b"GET / HTTP/1.1\r\n", 0.05)) for client in hostile]
        for client in hostile:
            with pytest.raises(ConnectionLost):
                await asyncio.wait_for(client.read(), 10)
        await asyncio.gather(*drips)
        honest = await TcpConnection.open(place)
        await honest.write(b"GET /metrics HTTP/1.1\r\n\r\n")
        assert (await honest.read()).startswith(b"HTTP/1.1 200")
        for client in (*hostile, honest):
            await client.aclose()
        await server.aclose()

    run(main())


def test_answers_without_an_end_do_not_prolong_a_call() -> None:
    """A process that answers other requests forever: the call ends at its timeout."""

    async def main() -> None:
        async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            with contextlib.suppress(ConnectionError):
                while True:
                    writer.write(json.dumps({"v": 1, "id": 999, "ok": True}).encode() + b"\n")
                    await writer.drain()
                    await asyncio.sleep(0)
            writer.close()

        server = await asyncio.start_server(serve, "127.0.0.1", 0)
        client = await ControlClient.connect_tcp("127.0.0.1", server.sockets[0].getsockname()[1])
        with pytest.raises(ReplyTimeout):
            await client.call("echo", 0.3)
        await client.aclose()
        server.close()
        await server.wait_closed()

    run(main())


# -- CAN ---------------------------------------------------------------------------------------------------------------


def test_a_client_with_a_slow_hello_is_refused_and_the_bus_continues(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bus_server, "HELLO_TIMEOUT_S", 0.4)

    async def main() -> None:
        server = await SoftBusServer.open(Endpoint.parse("can:fieldtwin/127.0.0.1:0"), 125_000, paced=False)
        one, other = server.attach("one"), server.attach("other")
        hostile = await TcpConnection.open(Endpoint.parse(f"tcp://127.0.0.1:{server.bound.address[1]}"))
        drip = asyncio.ensure_future(dripping(hostile.write, BusHello(0).pack()[:23], 0.05))
        number = 0
        while not server.turned_away:
            number += 1
            await one.send(CanFrame(0x181, number.to_bytes(4)))
            assert (await other.recv()).data == number.to_bytes(4)
        with pytest.raises(ConnectionLost):
            await hostile.read()
        await drip
        await hostile.aclose()
        await server.aclose()

    run(main())


MUX = bytes.fromhex("00 20 00")
TIMEOUT = NS


def segment(request: bytes) -> bytes:
    """One byte, and not the last segment; the toggle bit is the request's."""
    return bytes([request[0] & 0x10 | 6 << 1, 0x55]) + bytes(6)


def slow_upload(request: bytes) -> bytes:
    return b"\x40" + MUX + bytes(4) if request[0] == 0x40 else segment(request)


def slow_download(request: bytes) -> bytes:
    return b"\x60" + MUX + bytes(4) if request[0] >> 5 == 1 else bytes([0x20 | request[0] & 0x10]) + bytes(7)


def slow_block_download(request: bytes) -> bytes:
    return b"\xa4" + MUX + b"\x01" + bytes(3) if request[0] == 0xC6 else b"\xa2\x01\x01" + bytes(5)


@pytest.mark.parametrize(
    ("transfer", "answer"),
    [
        (lambda: SdoUpload(5, 0x2000, 0, TIMEOUT), slow_upload),
        (lambda: SdoDownload(5, 0x2000, 0, TIMEOUT, bytes(1 << 19)), slow_download),
        (lambda: SdoBlockDownload(5, 0x2000, 0, TIMEOUT, bytes(1 << 19)), slow_block_download),
    ],
    ids=["upload", "download", "block download"],
)
def test_an_sdo_transfer_that_drips_ends_within_its_limit(
    transfer: Callable[[], SdoTransfer], answer: Callable[[bytes], bytes]
) -> None:
    """Each reply comes 10 ms before its timeout."""
    made, now_ns = transfer(), 7 * NS
    began_ns = now_ns
    frame = made.start(now_ns)
    while True:
        now_ns = min(now_ns + TIMEOUT - NS // 100, made.deadline_ns)
        step = made.expire(now_ns)
        if isinstance(step, Failed):
            break
        step = made.feed(CanFrame(0x585, answer(frame.data)), now_ns)
        assert isinstance(step, SendFrame), step
        frame = step.frame
    assert isinstance(step.error, ReplyTimeout)
    assert "not complete after" in str(step.error)
    assert step.abort is not None
    moved_at_most = 7 * 2 * WHOLE_TIMEOUTS
    assert now_ns - began_ns <= WHOLE_TIMEOUTS * TIMEOUT + moved_at_most * WHOLE_NS_PER_BYTE


def test_a_block_upload_that_drips_ends_within_its_limit() -> None:
    """A segment of 7 bytes every 490 ms: within a block, the client acknowledges the received part after half a timeout."""
    made, now_ns, number, moved = SdoBlockUpload(5, 0x2000, 0, TIMEOUT), 0, 0, 0
    made.start(now_ns)
    step: object = made.feed(CanFrame(0x585, b"\xc4" + MUX + bytes(4)), now_ns)
    while True:
        now_ns = min(now_ns + 49 * NS // 100, made.deadline_ns)
        step = made.expire(now_ns)
        if isinstance(step, Failed):
            break
        number, moved = number % 63 + 1, moved + 7
        step = made.feed(CanFrame(0x585, bytes([number]) + bytes(7)), now_ns)
        assert isinstance(step, SendFrame | WaitForFrame), step
    assert isinstance(step.error, ReplyTimeout)
    assert now_ns <= WHOLE_TIMEOUTS * TIMEOUT + moved * WHOLE_NS_PER_BYTE


def test_an_object_of_known_length_is_not_read_beyond_it() -> None:
    """A tag has a type, and thus a length: a node that sends a byte every 50 ms forever is stopped after a few seconds."""
    made, now_ns = SdoUpload(5, 0x2000, 0, TIMEOUT, length=4), 0
    made.start(now_ns)
    step = made.feed(CanFrame(0x585, b"\x40" + MUX + bytes(4)), now_ns)
    while isinstance(step, SendFrame):
        now_ns += NS // 20
        step = made.feed(CanFrame(0x585, segment(step.frame.data)), now_ns)
    assert isinstance(step, Failed)
    assert "more than 64 bytes" in str(step.error)


def test_a_long_object_of_an_ordinary_node_is_read_whole() -> None:
    """A segment every 50 ms, with a timeout of 100 ms: 2000 segments take 1000 timeouts, and are not an attack."""
    made, now_ns = SdoUpload(5, 0x2000, 0, NS // 10), 0
    made.start(now_ns)
    step = made.feed(CanFrame(0x585, b"\x40" + MUX + bytes(4)), now_ns)
    for _ in range(2000):
        assert isinstance(step, SendFrame)
        now_ns += NS // 20
        assert made.expire(now_ns) is None
        step = made.feed(CanFrame(0x585, bytes([step.frame.data[0] & 0x10]) + bytes(7)), now_ns)


def test_a_slow_node_does_not_delay_another_one() -> None:
    async def main() -> None:
        ours, theirs = bus()
        answered = 0

        async def nodes() -> None:
            nonlocal answered
            while True:
                frame = await theirs.recv()
                if frame.can_id == 0x605 and frame.data[0] != 0x80:
                    asyncio.get_running_loop().call_later(
                        0.99, lambda request=frame: ours.feed(CanFrame(0x585, slow_upload(request.data)))
                    )
                elif frame.can_id == 0x606:
                    answered += 1
                    ours.feed(CanFrame(0x586, b"\x43" + frame.data[1:4] + answered.to_bytes(4, "little")))

        master = CanopenMaster(ours, LoopClock(), sdo_timeout_s=1.0, sdo_retries=0)
        async with running(master):
            task = asyncio.ensure_future(nodes())
            hostile = asyncio.ensure_future(master.sdo_upload(5, 0x2000, 0))
            number = 0
            while not hostile.done():
                number += 1
                value = await master.sdo_upload(6, 0x2000, 0)
                assert value == number.to_bytes(4, "little")
                await asyncio.sleep(0.5)
            with pytest.raises(ReplyTimeout, match="not complete after"):
                await hostile
            assert number >= 20
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)

    run_virtual(main())
