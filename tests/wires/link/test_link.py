"""The emulated connection: bytes unchanged, in order, exactly once; carriers that are lost and restored; bounds."""

from __future__ import annotations

import asyncio
import contextlib
import os
import random
import socket
import struct
import termios
import tty
from collections.abc import AsyncIterator
from pathlib import Path

import pytest
from support import eventually, run

from fieldtwin.emulators.endpoints.link_ends import MAX_PENDING, TcpEnd, TtyEnd
from fieldtwin.emulators.link import EmulatedConnection, EmulatedLink, LinkOptions, run_link
from fieldtwin.gateway.core.connection import PROTOCOL, TCPConnection
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import Bug, ConnectionLost, EndpointBusy, Unreachable, UsageError

QUICK = LinkOptions(backoff_s=0.01, backoff_max_s=0.05, half_close_s=0.2, stall_s=0.1)


class Driver:
    """A program that opens the virtual serial port: a bare descriptor."""

    def __init__(self, path: Path) -> None:
        self.fd = os.open(path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        tty.setraw(self.fd)
        termios.tcflush(self.fd, termios.TCIFLUSH)

    async def send(self, data: bytes) -> None:
        rest = memoryview(data)

        def gone() -> bool:
            nonlocal rest
            with contextlib.suppress(BlockingIOError):
                rest = rest[os.write(self.fd, rest) :]
            return not rest

        await eventually(gone)

    async def receive(self, size: int, within_s: float = 5.0) -> bytes:
        got = bytearray()

        def enough() -> bool:
            with contextlib.suppress(BlockingIOError):
                while len(got) < size:
                    got.extend(os.read(self.fd, 65536))
            return len(got) >= size

        await eventually(enough, within_s)
        return bytes(got)

    def close(self) -> None:
        os.close(self.fd)


class Far:
    """The emulator's side: a listening socket and its one client."""

    def __init__(self) -> None:
        self.listener = socket.create_server(("127.0.0.1", 0))
        self.listener.setblocking(False)
        self.endpoint = Endpoint("tcp", host="127.0.0.1", port=self.listener.getsockname()[1])

    async def accept(self) -> socket.socket:
        client, _ = await asyncio.wait_for(asyncio.get_running_loop().sock_accept(self.listener), 5)
        client.setblocking(False)
        return client

    def __enter__(self) -> Far:
        return self

    def __exit__(self, *_: object) -> None:
        self.listener.close()


async def receive(sock: socket.socket, size: int) -> bytes:
    data = b""
    while len(data) < size:
        chunk = await asyncio.wait_for(asyncio.get_running_loop().sock_recv(sock, 65536), 5)
        assert chunk, f"ended after {len(data)} of {size} bytes"
        data += chunk
    return data


@contextlib.asynccontextmanager
async def running(
    near: Endpoint, far: Endpoint, options: LinkOptions = QUICK
) -> AsyncIterator[tuple[EmulatedLink, list[str]]]:
    events: list[str] = []
    ready: asyncio.Future[EmulatedLink] = asyncio.get_running_loop().create_future()
    task = asyncio.create_task(run_link(near, far, options, on_event=events.append, on_ready=ready.set_result))
    await asyncio.wait((task, ready), return_when=asyncio.FIRST_COMPLETED)
    if task.done():
        task.result()
    try:
        yield ready.result(), events
    finally:
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task


def reset(sock: socket.socket) -> None:
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    sock.close()


def port(tmp_path: Path) -> Endpoint:
    return Endpoint.parse(f"pty:{tmp_path}/line1")


def test_an_emulated_connection_is_of_type_tcp_and_changes_nothing() -> None:
    connection = EmulatedConnection(PROTOCOL.RS232)
    assert isinstance(connection, TCPConnection)
    assert connection.type is PROTOCOL.TCP
    assert connection.protocol is PROTOCOL.RS232
    assert not connection.data_stream
    every = bytes(range(256))
    assert connection.emulate_write(every) == every
    assert connection.emulate_read(every[:3]) == every[:3]
    assert (connection.written_bytes, connection.read_bytes) == (256, 3)
    connection.write(b"a")
    assert connection.read() == b"a"
    with pytest.raises(Bug):
        EmulatedConnection(PROTOCOL.CAN)


def test_every_byte_passes_in_both_directions_exactly_once(tmp_path: Path) -> None:
    seeded = random.Random(7)
    outward, inward = seeded.randbytes(200_000), seeded.randbytes(200_000)

    async def main() -> None:
        with Far() as far:
            async with running(port(tmp_path), far.endpoint) as (link, _):
                field = await far.accept()
                await eventually(lambda: link.connected)
                driver = Driver(tmp_path / "line1")
                sending = asyncio.create_task(driver.send(outward))
                assert await receive(field, len(outward)) == outward
                await sending
                answering = asyncio.create_task(asyncio.get_running_loop().sock_sendall(field, inward))
                assert await driver.receive(len(inward)) == inward
                await answering
                assert link.stats() == {
                    "sessions": 1,
                    "failed_attempts": 0,
                    "written_bytes": len(outward),
                    "read_bytes": len(inward),
                    "dropped_write_bytes": 0,
                    "dropped_read_bytes": 0,
                }
                driver.close()
                field.close()
        assert not (tmp_path / "line1").is_symlink()

    run(main())


@pytest.mark.parametrize("drop", ["fin", "rst"])
def test_the_port_stays_while_the_carrier_goes_and_comes_back(tmp_path: Path, drop: str) -> None:
    async def main() -> None:
        with Far() as far:
            async with running(port(tmp_path), far.endpoint) as (link, events):
                first = await far.accept()
                driver = Driver(tmp_path / "line1")
                await driver.send(b"one")
                assert await receive(first, 3) == b"one"
                first.close() if drop == "fin" else reset(first)
                second = await far.accept()
                await eventually(lambda: link.sessions == 2 and link.connected)
                await driver.send(b"two")  # through the same open descriptor
                assert await receive(second, 3) == b"two"
                await asyncio.get_running_loop().sock_sendall(second, b"back")
                assert await driver.receive(4) == b"back"
                assert any(text.startswith("disconnected") for text in events)
                driver.close()
                second.close()

    run(main())


def test_bytes_written_without_a_carrier_are_lost_and_counted_never_delivered_late(tmp_path: Path) -> None:
    async def main() -> None:
        with socket.socket() as sleeping:
            sleeping.bind(("127.0.0.1", 0))  # bound and not listening yet
            endpoint = Endpoint("tcp", host="127.0.0.1", port=sleeping.getsockname()[1])
            async with running(port(tmp_path), endpoint) as (link, events):
                driver = Driver(tmp_path / "line1")
                await driver.send(b"a stale request")
                await eventually(lambda: link.stats()["dropped_write_bytes"] == 15 and link.failed_attempts > 3)
                assert not link.connected
                assert sum(text.startswith("waiting") for text in events) == 1, "said once, not at every attempt"
                sleeping.listen()
                sleeping.setblocking(False)
                field, _ = await asyncio.wait_for(asyncio.get_running_loop().sock_accept(sleeping), 5)
                field.setblocking(False)
                await eventually(lambda: link.connected)
                await driver.send(b"fresh")
                assert await receive(field, 5) == b"fresh"
                driver.close()
                field.close()

    run(main())


@pytest.mark.parametrize("away", ["waiting for a client", "between two attempts"])
def test_the_line_is_cut_while_there_is_no_carrier(tmp_path: Path, away: str) -> None:
    async def main() -> None:
        with socket.socket() as nobody:
            nobody.bind(("127.0.0.1", 0))
            if away == "waiting for a client":
                far = Endpoint.parse("tcp://127.0.0.1:0?listen=1")
            else:
                far = Endpoint("tcp", host="127.0.0.1", port=nobody.getsockname()[1])
            async with running(port(tmp_path), far, LinkOptions(backoff_s=60, backoff_max_s=60)) as (link, _):
                if away == "between two attempts":
                    await eventually(lambda: link.failed_attempts == 1)
                driver = Driver(tmp_path / "line1")
                await driver.send(b"a stale request")
                await eventually(lambda: link.stats()["dropped_write_bytes"] == 15)
                driver.close()

    run(main())


def test_bytes_in_transit_are_bounded_and_a_slow_driver_loses_nothing(tmp_path: Path) -> None:
    sent = random.Random(3).randbytes(8_000_000)  # more than both sockets and the link together hold

    async def main() -> None:
        with Far() as far:
            async with running(port(tmp_path), far.endpoint, LinkOptions(stall_s=60)) as (link, _):
                field = await far.accept()
                driver = Driver(tmp_path / "line1")
                sending = asyncio.create_task(asyncio.get_running_loop().sock_sendall(field, sent))
                end = link._far.connection
                assert isinstance(end, TcpEnd)
                await eventually(lambda: end.wire.paused)
                assert len(end.inbound.data_stream) <= MAX_PENDING
                assert not sending.done()
                got = await driver.receive(1_000_000, within_s=10)
                assert got == sent[: len(got)]
                sending.cancel()
                await asyncio.gather(sending, return_exceptions=True)
                driver.close()
                field.close()

    run(main())


def test_a_far_side_that_finished_sending_still_gets_its_answer(tmp_path: Path) -> None:
    async def main() -> None:
        with Far() as far:
            async with running(port(tmp_path), far.endpoint) as (_, _events):
                field = await far.accept()
                driver = Driver(tmp_path / "line1")
                await asyncio.get_running_loop().sock_sendall(field, b"question")
                field.shutdown(socket.SHUT_WR)
                assert await driver.receive(8) == b"question"
                await driver.send(b"answer")
                assert await receive(field, 6) == b"answer"
                assert await asyncio.wait_for(asyncio.get_running_loop().sock_recv(field, 9), 5) == b""
                field.close()
                (await far.accept()).close()
                driver.close()

    run(main())


def test_a_listening_side_accepts_one_client_at_a_time(tmp_path: Path) -> None:
    async def main() -> None:
        loop = asyncio.get_running_loop()
        listen = Endpoint.parse("tcp://127.0.0.1:0?listen=1")
        async with running(port(tmp_path), listen) as (link, _):
            address = link.ends[1].address
            assert address[1] != 0
            driver = Driver(tmp_path / "line1")
            master, intruder, next_master = (socket.socket() for _ in range(3))
            for sock in (master, intruder, next_master):
                sock.setblocking(False)
            await loop.sock_connect(master, address)
            await eventually(lambda: link.connected)
            await loop.sock_connect(intruder, address)
            with contextlib.suppress(ConnectionResetError):
                assert await asyncio.wait_for(loop.sock_recv(intruder, 1), 5) == b""
            await loop.sock_sendall(master, b"still mine")
            assert await driver.receive(10) == b"still mine"
            master.close()
            await eventually(lambda: not link.connected)
            await loop.sock_connect(next_master, address)
            await eventually(lambda: link.connected)
            await driver.send(b"welcome")
            assert await receive(next_master, 7) == b"welcome"
            driver.close()
            intruder.close()
            next_master.close()

    run(main())


def test_two_links_are_a_serial_line_across_tcp(tmp_path: Path) -> None:
    async def main() -> None:
        here, there = Endpoint.parse(f"pty:{tmp_path}/here"), Endpoint.parse(f"pty:{tmp_path}/there")
        async with running(there, Endpoint.parse("tcp://127.0.0.1:0?listen=1")) as (listening, _):
            carrier = Endpoint("tcp", host="127.0.0.1", port=listening.ends[1].port)
            async with running(here, carrier) as (dialling, _events):
                await eventually(lambda: listening.connected and dialling.connected)
                a, b = Driver(tmp_path / "here"), Driver(tmp_path / "there")
                await a.send(b"\x01\x03\x00\x00\x00\x02\xc4\x0b")
                assert await b.receive(8) == b"\x01\x03\x00\x00\x00\x02\xc4\x0b"
                await b.send(b"\xff\x00\x11\x13")
                assert await a.receive(4) == b"\xff\x00\x11\x13"
                a.close()
                b.close()

    run(main())


def test_a_serial_device_as_the_near_side_unplugged_and_back(tmp_path: Path) -> None:
    """A pty replaces the device; its replacement gets the same name."""

    async def main() -> None:
        device = tmp_path / "ttyUSB0"
        with Far() as far:
            near = Endpoint.parse(f"rtu:{device}?baudrate=9600&frame=8N1")
            async with running(near, far.endpoint) as (link, events):
                await eventually(lambda: any("cannot open the serial device" in text for text in events))
                for word in (b"first", b"again"):
                    master, slave = os.openpty()
                    device.unlink(missing_ok=True)
                    device.symlink_to(os.ttyname(slave))
                    os.close(slave)
                    field = await far.accept()
                    await eventually(lambda: link.connected)
                    os.write(master, word)
                    assert await receive(field, 5) == word
                    await asyncio.get_running_loop().sock_sendall(field, b"reply")
                    os.set_blocking(master, True)
                    assert await asyncio.to_thread(os.read, master, 5) == b"reply"
                    os.close(master)
                    await eventually(lambda: not link.connected)
                    field.close()

    run(main())


def test_an_unread_port_loses_bytes_and_does_not_block_the_link(tmp_path: Path) -> None:
    async def main() -> None:
        loop = asyncio.get_running_loop()
        with Far() as far:
            async with running(port(tmp_path), far.endpoint) as (link, events):
                field = await far.accept()
                sending = asyncio.create_task(loop.sock_sendall(field, bytes(500_000)))
                await eventually(lambda: link.stats()["dropped_read_bytes"] > 0)
                assert any("no program reads the bytes" in text for text in events)
                sending.cancel()
                with contextlib.suppress(asyncio.CancelledError):
                    await sending
                driver = Driver(tmp_path / "line1")
                await driver.send(b"here I am")
                assert await receive(field, 9) == b"here I am"
                driver.close()
                field.close()

    run(main())


def test_between_two_tcp_sides_a_half_close_is_passed_on() -> None:
    async def main() -> None:
        loop = asyncio.get_running_loop()
        with Far() as far, socket.socket() as client:
            async with running(Endpoint.parse("tcp://127.0.0.1:0?listen=1"), far.endpoint) as (link, _):
                assert link.connection.protocol is PROTOCOL.TCP
                client.setblocking(False)
                await loop.sock_connect(client, link.ends[0].address)
                await loop.sock_sendall(client, b"request")
                client.shutdown(socket.SHUT_WR)
                field = await far.accept()
                assert await receive(field, 7) == b"request"
                assert await asyncio.wait_for(loop.sock_recv(field, 1), 5) == b""
                await loop.sock_sendall(field, b"reply")
                field.close()
                assert await receive(client, 5) == b"reply"
                assert await asyncio.wait_for(loop.sock_recv(client, 1), 5) == b""

    run(main())


def test_an_impossible_link_is_refused_at_start(tmp_path: Path) -> None:
    async def main() -> None:
        with pytest.raises(UsageError, match="carried over TCP"):
            await run_link(port(tmp_path), Endpoint.parse(f"pty:{tmp_path}/b"))
        with pytest.raises(UsageError, match="cannot be an end"):
            await run_link(port(tmp_path), Endpoint.parse("can:socketcan/can0"))
        with Far() as far:
            listen = Endpoint.parse(f"tcp://127.0.0.1:{far.endpoint.port}?listen=1")
            with pytest.raises(EndpointBusy):
                await run_link(port(tmp_path), listen)
        assert not (tmp_path / "line1").is_symlink(), "the port that was made first is gone again"

    run(main())


def test_an_invalid_or_busy_serial_device_is_reported(tmp_path: Path) -> None:
    async def main() -> None:
        (tmp_path / "file").touch()
        with pytest.raises(Unreachable, match="not a serial device"):
            TtyEnd.open(Endpoint.parse(f"rtu:{tmp_path}/file"))
        master, slave = os.openpty()
        endpoint = Endpoint.parse(f"rtu:{os.ttyname(slave)}?frame=8N1")
        first = TtyEnd.open(endpoint)
        with pytest.raises(EndpointBusy):
            TtyEnd.open(endpoint)
        await first.aclose()
        with pytest.raises(UsageError, match="baud rate"):
            TtyEnd.open(Endpoint.parse(f"rtu:{os.ttyname(slave)}?baudrate=12345"))
        with pytest.raises(ConnectionLost):
            await first.write(b"x")
        os.close(master)
        os.close(slave)

    run(main())
