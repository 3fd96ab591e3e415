"""`UdpConnection` and the client on it, against real sockets: datagram boundaries, loss, order, foreign datagrams, floods."""

from __future__ import annotations

import asyncio
import contextlib
import socket
from collections.abc import AsyncIterator

import pytest
from support import eventually, run

from fieldtwin.gateway.connections.os_connector import OsConnector
from fieldtwin.gateway.connections.sockets.udp import UdpConnection
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import ConnectionLost, ReplyTimeout, Unreachable
from fieldtwin.gateway.protocols.modbus.client import ModbusClient
from fieldtwin.gateway.wallclock import WallClock

READ = bytes.fromhex("0000 0006 01 03 0000 0001")


@contextlib.asynccontextmanager
async def device() -> AsyncIterator[tuple[UdpConnection, socket.socket]]:
    """A connection, and the bare socket of its peer."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as peer:
        peer.bind(("127.0.0.1", 0))
        peer.setblocking(False)
        endpoint = Endpoint.parse(f"udp://127.0.0.1:{peer.getsockname()[1]}")
        connection = await OsConnector().open_bytes(endpoint)
        assert isinstance(connection, UdpConnection)
        try:
            yield connection, peer
        finally:
            await connection.aclose()


async def request(peer: socket.socket) -> tuple[bytes, tuple[str, int]]:
    data, sender = await asyncio.get_running_loop().sock_recvfrom(peer, 2048)
    return data, sender


def adu(transaction: bytes, value: int) -> bytes:
    return transaction + bytes.fromhex("0000 0005 01 03 02") + value.to_bytes(2, "big")


def test_each_chunk_is_a_datagram() -> None:
    async def main() -> None:
        async with device() as (connection, peer):
            await connection.write(b"one")
            await connection.write(b"two")
            data, sender = await request(peer)
            assert (data, (await request(peer))[0]) == (b"one", b"two")
            for chunk in (b"a", b"", b"bc"):
                peer.sendto(chunk, sender)
            assert [await connection.read(), await connection.read()] == [b"a", b"bc"]
            assert connection.dropped == 1  # the empty one

    run(main())


def test_a_lost_reply_is_a_timeout_and_a_late_one_is_identified_by_its_transaction_id() -> None:
    async def main() -> None:
        async with device() as (connection, peer):
            client = ModbusClient.at(connection.endpoint, connection, WallClock(), timeout_s=0.05)
            with pytest.raises(ReplyTimeout):
                await client.read_registers(1, "holding", 0, 1)
            first, sender = await request(peer)
            asking = asyncio.create_task(client.read_registers(1, "holding", 0, 1, timeout_s=5.0))
            second, _ = await request(peer)
            assert first[2:] == second[2:] == READ
            for late in (adu(first[:2], 1), adu(second[:2], 9)[:-1], adu(second[:2], 2), adu(second[:2], 2)):
                peer.sendto(late, sender)
            assert (await asking).registers == (2,)
            await eventually(lambda: bool(connection.inbound.data_stream) or client.counters.late_bytes == 22)
            asking = asyncio.create_task(client.read_registers(1, "holding", 0, 1, timeout_s=5.0))
            third, _ = await request(peer)
            peer.sendto(adu(third[:2], 3), sender)
            assert (await asking).registers == (3,)
            assert (client.counters.late_bytes, client.counters.noise_bytes) == (22, 10)

    run(main())


def test_datagrams_that_wait_together_are_not_joined() -> None:
    async def main() -> None:
        async with device() as (connection, peer):
            client = ModbusClient.at(connection.endpoint, connection, WallClock())
            asking = asyncio.create_task(client.read_registers(1, "holding", 0, 1))
            data, sender = await request(peer)
            peer.sendto(bytes.fromhex("0099 0000 000b 01 03 02"), sender)  # truncated: the rest is in no other datagram
            peer.sendto(adu(data[:2], 7), sender)
            assert (await asking).registers == (7,)

    run(main())


def test_a_foreign_datagram_is_ignored() -> None:
    async def main() -> None:
        async with device() as (connection, peer):
            await connection.write(b"?")
            _, sender = await request(peer)
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
                stranger.sendto(b"forged", sender)
            peer.sendto(b"true", sender)
            assert await connection.read() == b"true"

    run(main())


def test_no_program_listens() -> None:
    async def main() -> None:
        async with device() as (connection, peer):
            peer.close()
            await connection.write(b"?")
            with pytest.raises(ConnectionLost, match="no program listens"):
                await connection.read()
            with pytest.raises(ConnectionLost):
                await connection.write(b"?")

    run(main())


def test_a_name_without_an_address_is_unreachable() -> None:
    async def main() -> None:
        with pytest.raises(Unreachable, match="resolve"):
            await UdpConnection.open(Endpoint.parse("udp://no-such-host.invalid:502"))

    run(main())


def test_a_flood_is_bounded_and_counted() -> None:
    async def main() -> None:
        async with device() as (connection, peer):
            await connection.write(b"?")
            _, sender = await request(peer)
            taken = 0
            while not connection.dropped:
                peer.sendto(b"x" * 1400, sender)
                await asyncio.sleep(0)
                taken += 1
                assert taken < 10 * connection.max_pending
            assert len(connection.inbound.data_stream) == connection.max_pending

    run(main())


def test_a_datagram_that_is_too_long_ends_the_connection_with_a_reason() -> None:
    async def main() -> None:
        async with device() as (connection, _):
            with pytest.raises(ConnectionLost, match="cannot send"):
                await connection.write(bytes(70_000))

    run(main())


def test_closing_ends_reading_and_closing_twice_does_nothing() -> None:
    async def main() -> None:
        async with device() as (connection, _):
            reading = asyncio.create_task(connection.read())
            await asyncio.sleep(0)
            await connection.aclose()
            await connection.aclose()
            with pytest.raises(ConnectionLost, match="this side"):
                await reading

    run(main())
