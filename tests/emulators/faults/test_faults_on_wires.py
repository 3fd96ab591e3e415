"""Faults on real wires: a real TCP reset, a port that dies and returns, third-party programs on a link that get faults."""

from __future__ import annotations

import asyncio
import contextlib
from pathlib import Path
from typing import Any

import pytest
from support import eventually, run

from fieldtwin.emulators.endpoints.faulty.streams import FaultyEnd
from fieldtwin.emulators.endpoints.faulty.udp import FaultyDatagrams
from fieldtwin.emulators.endpoints.modbus_server import serve_udp
from fieldtwin.emulators.endpoints.ports import OsPorts
from fieldtwin.emulators.endpoints.pty import PtyEnd
from fieldtwin.emulators.faults.frames import Framing
from fieldtwin.emulators.faults.on_link import wire_faults
from fieldtwin.emulators.link import EmulatedLink
from fieldtwin.emulators.modbus.bank import CellSpan, MapBank
from fieldtwin.emulators.modbus.mbap import MbapServer
from fieldtwin.emulators.modbus.unit import ModbusUnit
from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.connection import ByteConnection
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import ConnectionLost
from fieldtwin.gateway.wallclock import WallClock

REQUEST = bytes.fromhex("0001 0000 0006 01 03 0000 0001")
REPLY = bytes.fromhex("0001 0000 0005 01 03 02 002A")


def at_once(*said: dict[str, Any], framing: Framing = Framing.MBAP) -> Any:
    return wire_faults(said, framing, 1, round(asyncio.get_running_loop().time() * NS_PER_S))


async def answers(connection: ByteConnection) -> None:
    """A device that answers every received frame."""
    with contextlib.suppress(ConnectionLost):
        while True:
            await connection.read()
            await connection.write(REPLY)


@contextlib.asynccontextmanager
async def device(faults: Any) -> Any:
    """The device on a socket, with faults; yields a function that connects to it."""

    async def client(connection: ByteConnection) -> None:
        end = FaultyEnd(connection, faults)
        try:
            await answers(end)
        finally:
            await end.aclose()

    listening = await OsPorts().listen(Endpoint.parse("tcp://127.0.0.1:0"), client, 4)
    writers: list[asyncio.StreamWriter] = []

    async def connect() -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
        reader, writer = await asyncio.open_connection(*listening.bound.address)
        writers.append(writer)
        return reader, writer

    try:
        yield connect
    finally:
        for writer in writers:
            writer.close()
            with contextlib.suppress(OSError):
                await writer.wait_closed()
        await listening.aclose()


def test_a_reset_is_one_inside_the_frame() -> None:
    async def main() -> None:
        async with device(at_once({"name": "reset", "at": 4, "nth": 2})) as connect:
            reader, writer = await connect()
            writer.write(REQUEST)
            assert await reader.readexactly(len(REPLY)) == REPLY
            writer.write(REQUEST)
            with pytest.raises(ConnectionResetError):
                await reader.read()  # up to the end of file, which does not exist
            again, writer = await connect()
            writer.write(REQUEST)
            assert await again.readexactly(len(REPLY)) == REPLY

    run(main())


def test_a_device_that_goes_away_ends_its_connections_in_order() -> None:
    async def main() -> None:
        faults = at_once()
        async with device(faults) as connect:
            reader, writer = await connect()
            writer.write(REQUEST)
            assert await reader.readexactly(len(REPLY)) == REPLY
            for active in at_once({"name": "disconnect"}).active.values():
                faults.put_in(active)
            assert await reader.read(100) == b""
            assert faults.refuses(active.from_ns)
            assert faults.take_away("disconnect-1")
            assert not faults.refuses(active.from_ns)

    run(main())


def test_half_open_is_silence_until_a_new_connection() -> None:
    async def main() -> None:
        async with device(at_once({"name": "half-open", "nth": 1})) as connect:
            reader, writer = await connect()
            writer.write(REQUEST)
            with pytest.raises(TimeoutError):
                await asyncio.wait_for(reader.read(1), 0.1)
            again, writer = await connect()
            writer.write(REQUEST)
            assert await again.readexactly(len(REPLY)) == REPLY

    run(main())


def test_a_split_frame_arrives_in_pieces() -> None:
    async def main() -> None:
        async with device(at_once({"name": "split", "at": 3, "pause_ms": 30})) as connect:
            reader, writer = await connect()
            writer.write(REQUEST)
            assert await reader.read(100) == REPLY[:3]
            assert await reader.read(100) == REPLY[3:]

    run(main())


def test_a_pty_receives_the_output_of_the_fault(tmp_path: Path) -> None:
    async def main() -> None:
        plant = Endpoint.parse("rtu:/dev/ttyS0?baudrate=19200&frame=8N1")
        port, _ = await OsPorts().serial(tmp_path / "line", plant, None)
        end = FaultyEnd(port, at_once({"name": "truncate", "count": 2}, {"name": "reset"}, framing=Framing.RAW))
        serving = asyncio.create_task(answers(end))
        other = (tmp_path / "line").open("r+b", buffering=0)
        try:
            other.write(REQUEST)
            heard = await asyncio.to_thread(other.read, 100)
            assert heard == REPLY[:4]
            assert isinstance(end.inner, PtyEnd)
            assert end.lost is None, "a line cannot be reset"
        finally:
            other.close()
            await end.aclose()
            await serving

    run(main())


@contextlib.asynccontextmanager
async def linked(stranger: Any, faults: Any) -> Any:
    """A client of the server `stranger`, through a link with `faults`."""
    server = await asyncio.start_server(stranger, "127.0.0.1", 0)
    far = Endpoint.parse(f"tcp://127.0.0.1:{server.sockets[0].getsockname()[1]}")
    link = EmulatedLink(Endpoint.parse("tcp://127.0.0.1:0?listen=1"), far, faults=faults)
    await link.open()
    serving = asyncio.create_task(link.serve())
    try:
        reader, writer = await asyncio.open_connection(*link.ends[0].address)
        yield reader, writer
        writer.close()
        await eventually(lambda: not link.connected)
    finally:
        serving.cancel()
        await asyncio.gather(serving, return_exceptions=True)
        await link.aclose()
        server.close()
        await server.wait_closed()


def test_a_link_injects_faults_between_third_party_programs() -> None:
    async def main() -> None:
        async def stranger(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            while await reader.read(100):
                writer.write(REPLY)
            writer.close()

        faults = at_once({"name": "exception", "code": 6, "function": 3, "every": 2})
        async with linked(stranger, faults) as (reader, writer):
            for expected in (REPLY, bytes.fromhex("0001 0000 0003 01 83 06"), REPLY):
                writer.write(REQUEST)
                assert await reader.readexactly(len(expected)) == expected
            assert [active.struck for active in faults.active.values()] == [1]

    run(main())


def test_a_link_puts_faults_between_two_programs_with_serial_ports(tmp_path: Path) -> None:
    """Clients are on the near side; data arriving there is a request."""

    async def main() -> None:
        near, far = (Endpoint("pty", path=str(tmp_path / name)) for name in ("master", "device"))
        faults = at_once({"name": "drop", "direction": "request", "nth": 1}, {"name": "truncate"}, framing=Framing.RAW)
        link = EmulatedLink(near, far, faults=faults)
        await link.open()
        serving = asyncio.create_task(link.serve())
        with (
            (tmp_path / "master").open("r+b", buffering=0) as master,
            (tmp_path / "device").open("r+b", buffering=0) as device,
        ):
            await eventually(lambda: link.connected)
            drop = next(iter(faults.active.values()))
            master.write(REQUEST)
            await eventually(lambda: drop.struck == 1)
            master.write(REQUEST[::-1])
            assert await asyncio.to_thread(device.read, 100) == REQUEST[::-1]
            device.write(REPLY)
            assert await asyncio.to_thread(master.read, 100) == REPLY[:-2]
        serving.cancel()
        await asyncio.gather(serving, return_exceptions=True)
        await link.aclose()

    run(main())


def test_a_link_strikes_whole_frames_of_a_stream_in_whatever_pieces_they_come() -> None:
    """A digital thread over TCP: a frame that is forwarded in parts, or damaged, would corrupt the stream."""

    async def main() -> None:
        sent = [bytes([n]) * 3000 for n in range(40)]

        async def stranger(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            stream = b"".join(len(data).to_bytes(2) + data for data in sent)
            for at in range(0, len(stream), 1777):
                writer.write(stream[at : at + 1777])
                await writer.drain()
                await asyncio.sleep(0)
            await reader.read()
            writer.close()

        said = [{"name": "drop", "direction": "reply", "every": 4}, {"name": "duplicate", "every": 3}]
        faults = wire_faults(said, Framing.THREAD, 1, 0)
        async with linked(stranger, faults) as (reader, _):
            got: list[int] = []
            while not got or got[-1] != 38:  # 39 is the fortieth, which is lost
                data = await reader.readexactly(int.from_bytes(await reader.readexactly(2)))
                assert data == data[:1] * 3000
                got.append(data[0])
            assert {n for n in range(39) if n not in got} == {n for n in range(39) if n % 4 == 3}
            assert len(got) > len(set(got)), "some came twice"

    run(main())


def test_faults_change_datagrams() -> None:
    async def main() -> None:
        faults = at_once(
            {"name": "drop", "direction": "request", "nth": 1},
            {"name": "delay", "by_ms": 5},
            {"name": "duplicate", "every": 2},
        )
        device = FaultyDatagrams(await OsPorts().datagrams(Endpoint.parse("udp://127.0.0.1:0")), faults)
        server = MbapServer({1: ModbusUnit(MapBank([CellSpan("holding", 0, 1)]))})
        serving = asyncio.create_task(serve_udp(device, server, WallClock()))
        heard: asyncio.Queue[bytes] = asyncio.Queue()

        class Asking(asyncio.DatagramProtocol):
            def datagram_received(self, data: bytes, addr: Any) -> None:
                heard.put_nowait(data)

        transport, _ = await asyncio.get_running_loop().create_datagram_endpoint(
            Asking, remote_addr=device.bound.address
        )
        try:
            answer = bytes.fromhex("0001 0000 0005 01 03 02 0000")
            for expected in (0, 1, 2):
                transport.sendto(REQUEST)
                for _ in range(expected):
                    assert await asyncio.wait_for(heard.get(), 5) == answer
            assert [active.struck for active in faults.active.values()] == [1, 2, 1]
        finally:
            transport.close()
            serving.cancel()
            await asyncio.gather(serving, return_exceptions=True)
            await device.aclose()

    run(main())
