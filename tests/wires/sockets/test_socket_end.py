"""The listening side of TCP, with real sockets: limits, half-open and half-closed clients, and Modbus over it."""

from __future__ import annotations

import asyncio
import socket
import struct

import pytest
from support import eventually, run

from fieldtwin.emulators.endpoints.modbus_server import serve_mbap
from fieldtwin.emulators.endpoints.socket_end import SocketEnd, SocketListener
from fieldtwin.emulators.modbus.bank import CellSpan, MapBank
from fieldtwin.emulators.modbus.mbap import MbapServer
from fieldtwin.emulators.modbus.unit import ModbusUnit
from fieldtwin.gateway.core.connection import ByteConnection, Direction
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import ConnectionLost, EndpointBusy, Unreachable
from fieldtwin.gateway.wallclock import WallClock

ANY_PORT = Endpoint.parse("tcp://127.0.0.1:0")
READ = bytes.fromhex("0001 0000 0006 01 03 0000 0001")
REPLY = bytes.fromhex("0001 0000 0005 01 03 02 0007")


async def echo(connection: ByteConnection) -> None:
    while True:
        await connection.write(await connection.read())


async def connect(listener: SocketListener) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
    return await asyncio.open_connection(*listener.bound.address)


async def hang_up(writer: asyncio.StreamWriter) -> None:
    writer.close()
    try:
        await writer.wait_closed()
    except OSError:
        pass


def test_port_0_takes_a_free_one_and_reports_it() -> None:
    async def main() -> None:
        listener = await SocketListener.open(ANY_PORT, echo)
        assert listener.bound.port > 0
        assert str(listener.bound).startswith("tcp://127.0.0.1:")
        reader, writer = await connect(listener)
        writer.write(b"hello")
        assert await reader.readexactly(5) == b"hello"
        assert listener.clients[0].peer == "{}:{}".format(*writer.get_extra_info("sockname"))
        await hang_up(writer)
        await eventually(lambda: not listener.clients)
        await listener.aclose()
        await listener.aclose()

    run(main())


def test_a_port_in_use_is_named() -> None:
    async def main() -> None:
        listener = await SocketListener.open(ANY_PORT, echo)
        with pytest.raises(EndpointBusy, match=f"tcp://127.0.0.1:{listener.bound.port}: the port is in use"):
            await SocketListener.open(listener.bound, echo)
        with pytest.raises(Unreachable, match="cannot listen"):
            await SocketListener.open(Endpoint.parse("tcp://192.0.2.1:0"), echo)
        await listener.aclose()

    run(main())


def test_mb_065_the_oldest_unused_client_gives_way() -> None:
    heard: list[bytes] = []

    async def listen(connection: ByteConnection) -> None:
        while True:
            heard.append(await connection.read())

    async def main() -> None:
        listener = await SocketListener.open(ANY_PORT, listen, max_clients=2)
        first, second = await connect(listener), await connect(listener)
        for _, writer in (second, first):  # the second connected last and was used first
            writer.write(b"x")
            await eventually(lambda: bool(heard))
            heard.clear()
        third = await connect(listener)
        assert await second[0].read() == b""
        for _, writer in (first, third):
            writer.write(b"y")
        await eventually(lambda: heard == [b"y", b"y"])
        assert (listener.accepted, listener.evicted) == (3, 1)
        for _, writer in (first, second, third):
            await hang_up(writer)
        await listener.aclose()

    run(main())


def test_a_client_that_only_stopped_sending_gets_its_answer() -> None:
    async def answer_late(connection: ByteConnection) -> None:
        await eventually(lambda: connection.lost is not None)
        await echo(connection)

    async def main() -> None:
        listener = await SocketListener.open(ANY_PORT, answer_late)
        reader, writer = await connect(listener)
        writer.write(b"last words")
        writer.write_eof()
        assert await reader.read() == b"last words"
        await hang_up(writer)
        await listener.aclose()

    run(main())


def test_mb_064_a_reset_ends_only_that_client() -> None:
    ends: list[str] = []

    async def noting(connection: ByteConnection) -> None:
        try:
            await echo(connection)
        except ConnectionLost as e:
            ends.append(str(e))
            raise

    async def main() -> None:
        listener = await SocketListener.open(ANY_PORT, noting)
        reader, writer = await connect(listener)
        other = socket.create_connection(listener.bound.address)
        await eventually(lambda: len(listener.clients) == 2)
        other.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        other.close()  # with linger 0: RST
        await eventually(lambda: len(listener.clients) == 1)
        assert "reset" in ends[0]
        writer.write(b"x")
        assert await reader.readexactly(1) == b"x"
        await listener.aclose()
        assert await reader.read() == b""
        await hang_up(writer)

    run(main())


def test_a_client_that_does_not_read_is_waited_for_and_closed_in_bounded_time() -> None:
    async def flood(connection: ByteConnection) -> None:
        while True:
            await connection.write(bytes(65536))

    async def main() -> None:
        listener = await SocketListener.open(ANY_PORT, flood)
        lazy = socket.create_connection(listener.bound.address)
        await eventually(lambda: bool(listener.clients) and listener.clients[0]._full)
        loop = asyncio.get_running_loop()
        before = loop.time()
        await listener.aclose()
        assert loop.time() - before < 3
        lazy.close()

    run(main())


def test_a_flooding_client_is_throttled() -> None:
    gate = asyncio.Event()

    async def slow(connection: ByteConnection) -> None:
        await gate.wait()
        await echo(connection)

    async def main() -> None:
        listener = await SocketListener.open(ANY_PORT, slow)
        reader, writer = await connect(listener)
        payload = bytes(range(256)) * 4096 * 24
        sending = asyncio.create_task(send_all(writer, payload))
        await eventually(lambda: bool(listener.clients) and len(listener.clients[0].inbound.data_stream) == 16)
        assert not sending.done()
        gate.set()
        async with asyncio.timeout(15):
            assert await reader.readexactly(len(payload)) == payload
        await sending
        await hang_up(writer)
        await listener.aclose()

    async def send_all(writer: asyncio.StreamWriter, payload: bytes) -> None:
        writer.write(payload)
        await writer.drain()

    run(main())


def test_a_failure_of_ours_is_reported_and_ends_only_that_client() -> None:
    reported: list[dict[str, object]] = []

    async def broken(connection: ByteConnection) -> None:
        if await connection.read() == b"bug":
            raise ZeroDivisionError
        await connection.write(b"fine")

    async def main() -> None:
        asyncio.get_running_loop().set_exception_handler(lambda _, context: reported.append(context))
        listener = await SocketListener.open(ANY_PORT, broken)
        reader, writer = await connect(listener)
        writer.write(b"bug")
        assert await reader.read() == b""
        await hang_up(writer)
        reader, writer = await connect(listener)
        writer.write(b"ok")
        assert await reader.read() == b"fine"
        await hang_up(writer)
        await listener.aclose()

    run(main())
    assert [type(context["exception"]) for context in reported] == [ZeroDivisionError]


def test_modbus_pipelined_in_order_and_visible_to_the_tap() -> None:
    bank = MapBank([CellSpan("holding", 0, 4)])
    bank.poke("holding", 0, 7)
    unit = ModbusUnit(bank)
    told: list[tuple[Direction, bytes]] = []
    times: list[int] = []

    def on_frame(direction: Direction, t_ns: int, data: bytes) -> None:
        told.append((direction, data))
        times.append(t_ns)

    async def main() -> None:
        listener = await SocketListener.open(
            ANY_PORT, lambda c: serve_mbap(c, MbapServer({1: unit}), WallClock(), latency_s=0.002, on_frame=on_frame)
        )
        reader, writer = await connect(listener)
        requests = [i.to_bytes(2, "big") + READ[2:] for i in range(1, 9)]
        writer.write(b"".join(requests))
        replies = [await reader.readexactly(len(REPLY)) for _ in requests]
        assert replies == [i.to_bytes(2, "big") + REPLY[2:] for i in range(1, 9)]
        assert [data for direction, data in told if direction is Direction.SENT] == requests
        await eventually(lambda: [data for direction, data in told if direction is Direction.RECEIVED] == replies)
        assert times == sorted(times), "the tap's times go back"
        assert times[-1] - times[0] >= 8 * 2_000_000, "latency of each reply"
        writer.write(bytes.fromhex("0001 0000 FFFF 01 03"))
        assert await reader.read() == b"", "MB-055: closed, as nothing can be understood any more"
        await hang_up(writer)
        await listener.aclose()

    run(main())
    assert (unit.counters.requests, unit.counters.replies) == (8, 8)


def units() -> dict[int, ModbusUnit]:
    bank = MapBank([CellSpan("holding", 0, 125)])
    bank.poke("holding", 0, 7)
    return {1: ModbusUnit(bank)}


def test_a_stream_that_makes_no_sense_is_answered_so_far_and_hung_up_on() -> None:
    async def main() -> None:
        listener = await SocketListener.open(ANY_PORT, lambda c: serve_mbap(c, MbapServer(units()), WallClock()))
        reader, writer = await connect(listener)
        writer.write(READ + bytes.fromhex("0002 0000 ffff 01"))
        assert await reader.read(100) == REPLY
        assert await reader.read(100) == b""
        await hang_up(writer)
        await listener.aclose()

    run(main())


def test_a_client_that_does_not_read_its_answers_is_not_read_from_and_gets_all_of_them_in_the_end() -> None:
    long_read = bytes.fromhex("0001 0000 0006 01 03 0000 007d")

    async def main() -> None:
        served: list[SocketEnd] = []
        server = MbapServer(units(), max_in_flight=1_000_000)

        async def serve(client: SocketEnd) -> None:
            served.append(client)
            await serve_mbap(client, server, WallClock())

        listener = await SocketListener.open(ANY_PORT, serve)
        reader, writer = await connect(listener)
        asked = 0
        for _ in range(200):  # far more than the kernel's buffers hold, so at some point no more is accepted
            writer.write(long_read * 500)
            asked += 500
            if writer.transport.get_write_buffer_size() > 1_000_000:
                break
            await asyncio.sleep(0)
        await eventually(lambda: server.requests > 0)
        assert server.requests < asked
        size = 0
        while size < asked * 259:
            size += len(await reader.read(1 << 20))
        assert server.requests == asked
        await hang_up(writer)
        await listener.aclose()

    run(main(), timeout_s=50)
