"""A bridge in one process: Modbus TCP clients, the gateway, and emulated units on a virtual serial port."""

from __future__ import annotations

import asyncio
import socket
import struct
from pathlib import Path

import pytest
from bridge_rig import ANY_PORT, WRITERS, read_adu, refused, rig, take
from support import eventually, run

from fieldtwin.gateway.connections.sockets.tcp import TcpConnection
from fieldtwin.gateway.core.errors import ConnectionLost
from fieldtwin.gateway.protocols.modbus.requests.refusals import GatewayRefusal
from fieldtwin.gateway.runtime.bridge.bridge import BridgeConfig, Route


def test_a_client_reads_units_of_the_line(tmp_path: Path) -> None:
    async def main() -> None:
        async with rig(tmp_path) as r, r.client() as client:
            assert (await client.read_registers(1, "holding", 3, 2)).registers == (103, 104)
            assert (await client.read_registers(2, "holding", 0, 1)).registers == (200,)
            assert (await client.read_bits(1, "coil", 0, 9)).bits == (False,) * 9

    run(main())


def test_mb_058_a_unit_without_a_route_gets_exception_0a(tmp_path: Path) -> None:
    async def main() -> None:
        config = BridgeConfig("b", ANY_PORT, routes={11: Route("line", 1), 255: Route("line", 2)})
        async with rig(tmp_path, config) as r, r.client() as client:
            assert await refused(client, 1) == 0x0A
            assert await refused(client, 0) == 0x0A
            assert (await client.read_registers(11, "holding", 0, 1)).registers == (100,)  # remapped
            assert (await client.read_registers(255, "holding", 0, 1)).registers == (200,)
            assert [frame[0] for frame in r.heard] == [1, 2]
            assert r.bridge.counters.no_path == 2

    run(main())


def test_mb_059_a_silent_target_is_0b_once_with_the_client_s_transaction_id(tmp_path: Path) -> None:
    async def main() -> None:
        async with rig(tmp_path) as r, r.raw() as raw:
            await raw.write(read_adu(0xBEEF, 9, 0, 1))
            assert await take(raw, 9) == bytes.fromhex("BEEF 0000 0003 09 83 0B")
            assert [frame[0] for frame in r.heard] == [9, 9]
            assert r.bus.totals()["timeouts"] == 2  # one attempt and the bus's one retry
            await raw.write(read_adu(0xBEF0, 9, 0, 1))  # backing off now: answered without the wire
            assert await take(raw, 9) == bytes.fromhex("BEF0 0000 0003 09 83 0B")
            assert r.bus.totals()["timeouts"] == 2
            assert r.bridge.counters.spared == 1
            await raw.write(read_adu(0xBEF1, 1, 0, 1))
            assert await take(raw, 11) == bytes.fromhex("BEF1 0000 0005 01 03 02 0064")

    run(main())


def test_mb_059_a_unit_that_comes_back_is_asked_again(tmp_path: Path) -> None:
    async def main() -> None:
        async with rig(tmp_path) as r, r.client() as client:
            r.units[1].diagnostics.listen_only = True
            assert await refused(client, 1) == 0x0B
            r.units[1].diagnostics.listen_only = False

            async def answers() -> bool:
                try:
                    return (await client.read_registers(1, "holding", 0, 1)).registers == (100,)
                except GatewayRefusal:
                    return False

            await eventually(answers)
            assert r.bridge.status().away == []

    run(main())


def test_mb_060_a_client_gone_mid_request(tmp_path: Path) -> None:
    async def main() -> None:
        async with rig(tmp_path, latency_s=0.1) as r, r.client() as stays:
            with socket.create_connection(("127.0.0.1", r.port)) as goes:
                goes.sendall(read_adu(1, 1, 0, 1) + read_adu(2, 1, 1, 1) + read_adu(3, 1, 2, 1))
                await eventually(lambda: len(r.heard) == 1)
                goes.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))  # it ends by a reset
            await eventually(lambda: r.bridge.counters.unread == 1)  # the reply in transit is dropped
            assert (await stays.read_registers(2, "holding", 5, 1)).registers == (205,)
            assert [frame[0] for frame in r.heard] == [1, 2]  # its queued requests were never sent
            assert r.bus.guests.counters.gone == 2
            assert r.bus.totals()["late_bytes"] == 0

    run(main())


def test_mb_061_two_clients_with_the_same_transaction_ids(tmp_path: Path) -> None:
    async def main() -> None:
        async with rig(tmp_path, latency_s=0.005) as r, r.raw() as a, r.raw() as b:
            for turn in range(20):
                await a.write(read_adu(7, 1, turn, 1))
                await b.write(read_adu(7, 2, turn, 1))
                of_a, of_b = await asyncio.gather(take(a, 11), take(b, 11))
                assert of_a == bytes.fromhex("0007 0000 0005 01 03 02") + (100 + turn).to_bytes(2)
                assert of_b == bytes.fromhex("0007 0000 0005 02 03 02") + (200 + turn).to_bytes(2)

    run(main())


def test_mb_062_one_dead_unit_costs_the_others_nothing(tmp_path: Path) -> None:
    async def main() -> None:
        async with rig(tmp_path, timeout_s=0.05) as r, r.client() as well, r.client() as ill:
            asking = True

            async def ask_the_dead() -> int:
                asked = 0
                while asking:
                    assert await refused(ill, 9) == 0x0B
                    asked += 1
                    await asyncio.sleep(0.001)
                return asked

            dead = asyncio.create_task(ask_the_dead())
            await eventually(lambda: r.bridge.counters.spared > 5)
            loop = asyncio.get_running_loop()
            start = loop.time()
            replies = 0
            while loop.time() - start < 1.0:
                await well.read_registers(1, "holding", 0, 1)
                replies += 1
            asking = False
            assert await dead > 50
            timeouts = r.bus.totals()["timeouts"]
            assert timeouts <= 5, "a dead unit was asked again and again"
            assert replies > 50

    run(main())


def test_mb_028_a_broadcast_is_sent_once_and_gets_no_reply(tmp_path: Path) -> None:
    async def main() -> None:
        config = BridgeConfig("b", ANY_PORT, to="line", policy=WRITERS, broadcast=True)
        async with rig(tmp_path, config) as r, r.raw() as raw:
            write = bytes.fromhex("0001 0000 0006 00 06 0005 1234")
            await raw.write(write + read_adu(2, 1, 5, 1))
            assert await take(raw, 11) == bytes.fromhex("0002 0000 0005 01 03 02 1234")  # no answer to the first
            assert r.units[2].bank.read("holding", 5, 1, 0) == [0x1234]
            assert [frame[0] for frame in r.heard] == [0, 1]
            assert await refused_raw(raw, 0) == 0x01  # a function that cannot be broadcast

    run(main())


def test_mb_028_a_broadcast_is_answered_if_configured_and_only_after_it_was_sent(tmp_path: Path) -> None:
    async def main() -> None:
        config = BridgeConfig("b", ANY_PORT, to="line", policy=WRITERS, broadcast=True, answer_broadcast=True)
        async with rig(tmp_path, config) as r, r.raw() as raw:
            await raw.write(bytes.fromhex("0001 0000 0009 00 10 0005 0001 02 4321"))
            assert await take(raw, 12) == bytes.fromhex("0001 0000 0006 00 10 0005 0001")
            await eventually(lambda: r.units[2].bank.read("holding", 5, 1, 0) == [0x4321])  # it was sent, so it arrives
        blocked = rig(tmp_path / "again", config, blocked=lambda bus, unit: "held")
        (tmp_path / "again").mkdir()
        async with blocked as r, r.raw() as raw:
            await raw.write(bytes.fromhex("0001 0000 0006 00 06 0005 1234"))
            assert await take(raw, 9) == bytes.fromhex("0001 0000 0003 00 86 0A")

    run(main())


async def refused_raw(raw: TcpConnection, unit: int) -> int:
    await raw.write(read_adu(9, unit, 0, 1))
    return (await take(raw, 9))[-1]


@pytest.mark.parametrize(
    ("case", "pdu", "code"),
    [
        ("MB-033, unknown and not allowed", "64 01", 0x01),
        ("MB-035", "83 02", 0x01),
        ("MB-036, none", "03 0000 0000", 0x03),
        ("MB-036, 126 registers", "03 0000 007E", 0x03),
        ("MB-036, 2001 bits", "01 0000 07D1", 0x03),
        ("MB-037", "03 FFFF 0002", 0x02),
        ("MB-038", "03 FFFF 007E", 0x03),
        ("MB-039", "05 0000 0001", 0x03),
        ("MB-040", "10 0000 0002 02 0001", 0x03),
        ("a write, by default", "06 0000 0001", 0x01),
        ("the unit's own refusal, as it is", "03 003F 0002", 0x02),
    ],
)
def test_refused_requests_and_their_exceptions(tmp_path: Path, case: str, pdu: str, code: int) -> None:
    data = bytes.fromhex(pdu)

    async def main() -> None:
        async with rig(tmp_path) as r, r.raw() as raw:
            await raw.write(bytes.fromhex("0007 0000") + (len(data) + 1).to_bytes(2) + b"\1" + data)
            assert await take(raw, 9) == bytes([0, 7, 0, 0, 0, 3, 1, data[0] | 0x80, code]), case
            assert (await refused_or_value(raw)) == 100  # and the next request is answered

    run(main())


async def refused_or_value(raw: TcpConnection) -> int:
    await raw.write(read_adu(8, 1, 0, 1))
    return int.from_bytes((await take(raw, 11))[-2:])


def test_mb_051_and_052_byte_by_byte_and_several_in_one_segment(tmp_path: Path) -> None:
    async def main() -> None:
        async with rig(tmp_path) as r, r.raw() as raw:
            for byte in read_adu(1, 1, 0, 1):
                await raw.write(bytes([byte]))
                await asyncio.sleep(0)
            assert await take(raw, 11) == bytes.fromhex("0001 0000 0005 01 03 02 0064")
            await raw.write(b"".join(read_adu(n, 1 + n % 2, n, 1) for n in range(10)))
            answers = await take(raw, 110)
            assert [int.from_bytes(answers[i : i + 2]) for i in range(0, 110, 11)] == list(range(10))
            assert [int.from_bytes(answers[i + 9 : i + 11]) for i in range(0, 110, 11)] == [
                100 * (1 + n % 2) + n for n in range(10)
            ]

    run(main())


def test_mb_053_too_many_in_flight(tmp_path: Path) -> None:
    async def main() -> None:
        config = BridgeConfig("b", ANY_PORT, to="line", in_flight=3)
        async with rig(tmp_path, config, latency_s=0.02) as r, r.raw() as raw:
            await raw.write(b"".join(read_adu(n, 1, n, 1) for n in range(5)))
            answers = await take(raw, 3 * 11 + 2 * 9)
            assert answers[33:] == bytes.fromhex("0003 0000 0003 01 83 06  0004 0000 0003 01 83 06")
            assert len(r.heard) == 3

    run(main())


def test_a_full_queue_is_busy(tmp_path: Path) -> None:
    async def main() -> None:
        config = BridgeConfig("b", ANY_PORT, to="line", queue=2)
        async with rig(tmp_path, config, latency_s=0.05) as r, r.raw() as a, r.raw() as b:
            await a.write(read_adu(1, 1, 0, 1) + read_adu(2, 1, 0, 1))
            await eventually(lambda: r.bridge.counters.requests == 2)
            await b.write(read_adu(3, 1, 0, 1))
            assert (await take(b, 9))[-1] == 0x06
            await take(a, 22)
            await b.write(read_adu(4, 1, 0, 1))
            assert (await take(b, 11))[-2:] == b"\x00\x64"
            assert r.bridge.counters.full == 1

    run(main())


def test_mb_054_another_protocol_is_dropped_alone(tmp_path: Path) -> None:
    async def main() -> None:
        async with rig(tmp_path) as r, r.raw() as raw:
            foreign = bytes.fromhex("0001 0001 0006 01 03 0000 0001")
            await raw.write(foreign + read_adu(2, 1, 0, 1))
            assert await take(raw, 11) == bytes.fromhex("0002 0000 0005 01 03 02 0064")
            await eventually(lambda: r.bridge.front.counters.foreign == 1)  # type: ignore[union-attr]

    run(main())


@pytest.mark.parametrize("length", [0, 1, 255, 0xFFFF])
def test_mb_055_an_impossible_length_ends_the_connection_and_nothing_else(tmp_path: Path, length: int) -> None:
    async def main() -> None:
        async with rig(tmp_path) as r, r.client() as other, r.raw() as raw:
            await raw.write(bytes.fromhex("0001 0000") + length.to_bytes(2) + b"\1\3")
            with pytest.raises(ConnectionLost):
                await take(raw, 1)
            assert (await other.read_registers(1, "holding", 0, 1)).registers == (100,)

    run(main())


def test_mb_064_a_reset_in_the_middle_of_a_frame(tmp_path: Path) -> None:
    async def main() -> None:
        async with rig(tmp_path) as r, r.client() as other:
            async with r.raw() as raw:
                await raw.write(read_adu(1, 1, 0, 1)[:5])
                await eventually(lambda: len(r.bridge.front.status().clients) == 2)
                raw._wire.transport.abort()
            await eventually(lambda: len(r.bridge.front.status().clients) == 1)
            assert (await other.read_registers(1, "holding", 0, 1)).registers == (100,)

    run(main())


def test_mb_065_the_oldest_unused_client_makes_room(tmp_path: Path) -> None:
    async def main() -> None:
        config = BridgeConfig("b", ANY_PORT, to="line", clients=2)
        async with rig(tmp_path, config) as r, r.client() as first, r.client() as second:
            for client in (second, first):  # the second one was silent for longer
                await client.read_registers(1, "holding", 0, 1)
            async with r.client() as third:
                assert (await third.read_registers(1, "holding", 0, 1)).registers == (100,)
                assert (await first.read_registers(1, "holding", 0, 1)).registers == (100,)
                await eventually(lambda: second.closed)
                assert r.bridge.front.status().counters["evicted"] == 1

    run(main())
