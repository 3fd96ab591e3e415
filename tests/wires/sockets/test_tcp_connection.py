"""`TcpConnection` against real sockets that behave correctly or incorrectly."""

from __future__ import annotations

import asyncio
import contextlib
import socket
import struct
from collections.abc import AsyncIterator, Awaitable, Callable

import pytest
from support import eventually, run

from fieldtwin.gateway.connections.sockets import tcp
from fieldtwin.gateway.connections.sockets.tcp import TcpConnection
from fieldtwin.gateway.core.connection import TCPConnection
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import ConnectionLost, Unreachable

Peer = Callable[[socket.socket], Awaitable[None]]


@contextlib.asynccontextmanager
async def connected(max_pending: int = 1024) -> AsyncIterator[tuple[TcpConnection, socket.socket]]:
    """A connection and the bare socket at its other end."""
    loop = asyncio.get_running_loop()
    with socket.create_server(("127.0.0.1", 0)) as listener:
        listener.setblocking(False)
        endpoint = Endpoint.parse("tcp://127.0.0.1:1").with_address("127.0.0.1", listener.getsockname()[1])
        connection = await TcpConnection.open(endpoint, max_pending=max_pending)
        peer, _ = await loop.sock_accept(listener)
        peer.setblocking(False)
        with peer:
            yield connection, peer
        await connection.aclose()


async def collect(connection: TcpConnection, size: int) -> bytes:
    data = b""
    while len(data) < size:
        data += await connection.read()
    return data


def test_bytes_pass_in_both_directions_and_the_socket_is_tuned() -> None:
    async def main() -> None:
        loop = asyncio.get_running_loop()
        async with connected() as (connection, peer):
            assert isinstance(connection.inbound, TCPConnection)
            await connection.write(b"\x00\x01\xff")
            assert await loop.sock_recv(peer, 100) == b"\x00\x01\xff"
            for byte in b"byte by byte":  # MB-051
                await loop.sock_sendall(peer, bytes([byte]))
            assert await collect(connection, 12) == b"byte by byte"
            sock = connection._wire.transport.get_extra_info("socket")
            assert sock.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)
            assert sock.getsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE)
            assert sock.getsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT) == tcp.UNACKNOWLEDGED_MS

    run(main())


def test_the_message_of_a_refusal_is_that_no_program_listens() -> None:
    async def main() -> None:
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))  # bound and not listening: no other program can take the port meanwhile
            endpoint = Endpoint("tcp", host="127.0.0.1", port=free.getsockname()[1])
            with pytest.raises(Unreachable, match="refused"):
                await TcpConnection.open(endpoint)
            with pytest.raises(Unreachable, match="refused"):  # every address of the name is tried
                await TcpConnection.open(endpoint.with_address("localhost", endpoint.port))

    run(main())


@pytest.mark.parametrize("host", ["nobody.invalid", "a..b", "x" * 64 + ".invalid"])
def test_a_name_that_does_not_resolve_is_named(host: str) -> None:
    async def main() -> None:
        with pytest.raises(Unreachable, match="does not resolve") as caught:
            await TcpConnection.open(Endpoint("tcp", host=host, port=502), timeout_s=10)
        assert host in str(caught.value)

    run(main())


def test_no_answer_ends_at_the_timeout() -> None:
    async def main() -> None:
        loop = asyncio.get_running_loop()
        with socket.socket() as listener, contextlib.ExitStack() as queued:
            listener.bind(("127.0.0.1", 0))
            listener.listen(0)
            address = listener.getsockname()
            for _ in range(4):  # a full accept queue drops the SYN, as a filtered port does
                filler = queued.enter_context(socket.socket())
                filler.setblocking(False)
                filler.connect_ex(address)
            began_s = loop.time()
            with pytest.raises(Unreachable, match=r"no answer within 0.3 s"):
                await TcpConnection.open(Endpoint("tcp", host=address[0], port=address[1]), timeout_s=0.3)
            assert loop.time() - began_s < 2

    run(main())


def test_end_of_stream_gives_received_bytes_and_then_the_loss() -> None:
    async def main() -> None:
        async with connected() as (connection, peer):
            peer.send(b"last words")
            peer.close()
            assert await collect(connection, 10) == b"last words"
            with pytest.raises(ConnectionLost, match="peer closed"):
                await connection.read()
            with pytest.raises(ConnectionLost):
                await connection.write(b"x")

    run(main())


def test_a_reset_in_the_middle_of_a_frame_is_a_loss() -> None:  # MB-064
    async def main() -> None:
        async with connected() as (connection, peer):
            reading = asyncio.create_task(collect(connection, 100))
            peer.send(b"\x00\x01\x00")
            await eventually(lambda: not connection.inbound.data_stream)
            peer.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            peer.close()
            with pytest.raises(ConnectionLost, match="reset"):
                await reading

    run(main())


def test_a_write_waits_for_a_peer_that_does_not_read_and_loses_nothing() -> None:
    chunk = bytes(n % 251 for n in range(50_000))

    async def main() -> None:
        async with connected() as (connection, peer):
            written = 0

            async def write_all() -> None:
                nonlocal written
                for _ in range(400):  # 20 MB, more than the sockets of both sides hold
                    await connection.write(chunk)
                    written += 1

            writing = asyncio.create_task(write_all())
            await eventually(lambda: not connection._wire.room.is_set())
            assert written < 400
            got = 0
            while got < 400 * len(chunk):
                data = await asyncio.get_running_loop().sock_recv(peer, 1 << 20)
                assert data
                start = got % len(chunk)
                assert data == (chunk * (2 + len(data) // len(chunk)))[start : start + len(data)]
                got += len(data)
            await writing

    run(main())


def test_a_slow_reader_throttles_the_peer_and_loses_nothing() -> None:
    async def main() -> None:
        loop = asyncio.get_running_loop()
        async with connected(max_pending=4) as (connection, peer):
            sent = bytes(n % 251 for n in range(1_000_000))
            sending = asyncio.create_task(loop.sock_sendall(peer, sent))
            await eventually(lambda: connection._wire.paused)
            got = bytearray()
            while len(got) < len(sent):
                assert len(connection.inbound.data_stream) <= 4
                got += await connection.read()
            await sending
            assert got == sent

    run(main())


def test_a_writer_that_waits_learns_of_the_loss() -> None:
    async def main() -> None:
        async with connected() as (connection, peer):

            async def write_for_ever() -> None:
                while True:
                    await connection.write(bytes(100_000))

            writing = asyncio.create_task(write_for_ever())
            await eventually(lambda: not connection._wire.room.is_set())
            peer.close()  # unread bytes: the kernel answers with a reset
            with pytest.raises(ConnectionLost):
                await writing

    run(main())


def test_closing_sends_written_bytes_even_to_a_peer_that_never_reads_within_bounds() -> None:
    async def main() -> None:
        loop = asyncio.get_running_loop()
        async with connected() as (connection, peer):
            await connection.write(b"safe value")
            await connection.aclose()
            assert await loop.sock_recv(peer, 100) == b"safe value"
            assert await loop.sock_recv(peer, 100) == b""
            with pytest.raises(ConnectionLost, match="closed on this side"):
                await connection.read()
            with pytest.raises(ConnectionLost, match="closed on this side"):
                await connection.write(b"x")
        async with connected() as (connection, peer):
            writing = asyncio.create_task(connection.write(bytes(20_000_000)))
            await eventually(lambda: not connection._wire.room.is_set())
            began_s = loop.time()
            await connection.aclose()
            assert loop.time() - began_s < 2
            with pytest.raises(ConnectionLost):
                await writing

    run(main())
