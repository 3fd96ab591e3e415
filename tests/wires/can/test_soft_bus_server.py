"""The software CAN bus over real TCP: the plant's end, the emulators' end and attached nodes on one bus."""

from __future__ import annotations

import asyncio
import itertools
import socket
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import pytest
from support import eventually, run

from fieldtwin.emulators.endpoints.can.bus_hello import FD_VERSION, VERSION, BusHello, Status, unpack_hello
from fieldtwin.emulators.endpoints.can.bus_server import SoftBusServer
from fieldtwin.emulators.endpoints.can.software_end import open_can_end
from fieldtwin.gateway.connections.can.soft_bus import SoftBusConnection
from fieldtwin.gateway.core.canframe import RECORD_SIZE, CanFrame, pack_record, unpack_record
from fieldtwin.gateway.core.connection import CanConnection
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import ConnectionLost, EndpointBusy, Unreachable, UsageError

ANY_PORT = Endpoint.parse("can:fieldtwin/127.0.0.1:0")


@asynccontextmanager
async def bus(bitrate: int = 125_000, **options: object) -> AsyncIterator[SoftBusServer]:
    server = await SoftBusServer.open(ANY_PORT, bitrate, **options)  # type: ignore[arg-type]
    try:
        yield server
    finally:
        await server.aclose()


async def take(connection: CanConnection, n: int) -> list[CanFrame]:
    return [await connection.recv() for _ in range(n)]


FRAMES = [
    CanFrame(0x000),
    CanFrame(0x7FF, bytes(range(8))),
    CanFrame(0x605, remote=True, dlc=8),
    CanFrame(0x1FFFFFFF, b"\xff", extended=True),
    CanFrame(0x5, remote=True, extended=True, dlc=3),
]


@pytest.mark.parametrize("sender", ["plant", "emulator", "attached"])
def test_every_kind_of_frame_from_every_kind_of_end_to_all_others(sender: str) -> None:
    async def main() -> None:
        async with bus() as server:
            ends: dict[str, CanConnection] = {
                "plant": await SoftBusConnection.open(server.bound, 125_000),
                "emulator": await open_can_end(server.bound, 125_000),
                "attached": server.attach("here"),
            }
            for frame in FRAMES:
                await ends[sender].send(frame)
            received = {name: await take(end, len(FRAMES)) for name, end in ends.items() if name != sender}
            for frames in received.values():
                assert [f.key() for f in frames] == [f.key() for f in FRAMES]
            times = {tuple(f.t_ns for f in frames) for frames in received.values()}
            assert len(times) == 1, "the bus's time of a frame is one for all"
            assert not ends[sender].inbound.data_stream, "a node does not receive its own frames"
            for end in ends.values():
                await end.aclose()

    run(main())


def test_exact_frame_times_and_real_pace() -> None:
    # Identifier 1 without data keeps the bus for 50 bits (tests/emulators/wires/test_can_timing.py): 400 us at 125 kbit/s.
    async def main() -> None:
        loop = asyncio.get_running_loop()
        async with bus() as server:
            a = await SoftBusConnection.open(server.bound, 125_000)
            b = await SoftBusConnection.open(server.bound, 125_000)
            began = loop.time()
            for _ in range(50):
                await a.send(CanFrame(0x001))
            times = [frame.t_ns for frame in await take(b, 50)]
            assert {after - before for before, after in itertools.pairwise(times)} == {400_000}
            assert loop.time() - began >= 49 * 0.0004
            assert times[0] >= began * 1e9
            assert times[-1] <= loop.time() * 1e9
            stats = server.bus_stats()
            assert (stats["frames"], stats["bits"]) == (50, 2500)
            assert 0 < stats["load"] <= 1
            await a.aclose()
            await b.aclose()
            await eventually(lambda: server.bus_stats()["nodes"] == [])

    run(main())


def test_arbitration_between_processes_ends() -> None:
    async def main() -> None:
        async with bus(500) as server:  # a bit is 2 ms: what follows is queued while the first is on the wire
            a, b = await SoftBusConnection.open(server.bound, 0), await open_can_end(server.bound, 0)
            watch = server.attach()
            await a.send(CanFrame(0x400, bytes(8)))
            await eventually(lambda: [n["queued"] for n in server.bus_stats()["nodes"]] == [1, 0, 0])
            await a.send(CanFrame(0x300))
            await b.send(CanFrame(0x200))
            assert [f.can_id for f in await take(watch, 3)] == [0x400, 0x200, 0x300]
            await a.aclose()
            await b.aclose()

    run(main())


def test_20000_frames_between_two_clients_in_order_and_whole() -> None:
    async def main() -> None:
        count = 10_000
        async with bus(paced=False) as server:
            a, b = await SoftBusConnection.open(server.bound, 125_000), await open_can_end(server.bound, 125_000)

            async def talk(end: CanConnection, can_id: int) -> None:
                for i in range(count):
                    await end.send(CanFrame(can_id, i.to_bytes(4)))

            async def hear(end: CanConnection, can_id: int) -> None:
                for i in range(count):
                    assert (await end.recv()).key() == CanFrame(can_id, i.to_bytes(4)).key()

            async with asyncio.TaskGroup() as group:
                group.create_task(talk(a, 0x181))
                group.create_task(talk(b, 0x201))
                group.create_task(hear(a, 0x201))
                group.create_task(hear(b, 0x181))
            stats = server.bus_stats()
            assert stats["by_id"] == {"181": count, "201": count}
            assert stats["overruns"] == a.overruns == b.overruns == 0
            assert await _confirmed(a, count)
            await a.aclose()
            await b.aclose()

    async def _confirmed(end: SoftBusConnection, count: int) -> bool:
        await eventually(lambda: end.confirmed == count)
        return True

    run(main(), timeout_s=40)


def test_late_joiner_receives_only_later_frames() -> None:
    async def main() -> None:
        async with bus(1000) as server:
            a = await SoftBusConnection.open(server.bound, 1000)
            for can_id in (0x10, 0x11, 0x12):
                await a.send(CanFrame(can_id, bytes(8)))
            await eventually(lambda: server.bus_stats()["nodes"][0]["queued"] > 0)
            late = await SoftBusConnection.open(server.bound, 1000)  # in the middle of the first: it takes 0.1 s
            assert (await late.recv()).can_id == 0x11
            await a.aclose()
            await late.aclose()

    run(main())


def test_a_full_queue_holds_back_its_sender_alone() -> None:
    async def main() -> None:
        async with bus(10_000, queue_frames=4) as server:
            a, b = (
                await SoftBusConnection.open(server.bound, 10_000),
                await SoftBusConnection.open(server.bound, 10_000),
            )
            for _ in range(4):
                await a.send(CanFrame(0x700))
            fifth = asyncio.create_task(a.send(CanFrame(0x700)))
            await b.send(CanFrame(0x001))  # not held back
            assert (await a.recv()).can_id == 0x001
            assert not fifth.done() or server.bus_stats()["frames"] >= 2
            await fifth
            assert len(await take(b, 5)) == 5
            await a.aclose()
            await b.aclose()

    run(main())


def test_a_client_that_floods_without_waiting_is_read_no_faster_than_the_bus_sends() -> None:
    async def main() -> None:
        async with bus(paced=False, queue_frames=8) as server:
            hear = server.attach()
            reader, writer = await asyncio.open_connection(*server.bound.address)
            writer.write(BusHello(0).pack())
            writer.write(b"".join(pack_record(CanFrame(0x100, i.to_bytes(2))) for i in range(3000)))
            writer.write_eof()  # and it leaves at once: everything still goes out
            for i in range(3000):
                assert (await hear.recv()).data == i.to_bytes(2)
            answer = unpack_hello(await reader.readexactly(RECORD_SIZE))
            assert answer is not None
            assert (answer.status, answer.window) == (Status.WELCOME, 8)
            assert await reader.read() == b""  # no confirmations unless asked for
            writer.close()
            await writer.wait_closed()

    run(main())


def test_a_slow_receiver_overruns_alone_and_blocks_no_other() -> None:
    async def main() -> None:
        async with bus(paced=False, max_outbound_frames=16) as server:
            slow = socket.socket()
            slow.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            slow.connect(server.bound.address)
            slow.sendall(BusHello(0).pack())
            await eventually(lambda: len(server.bus_stats()["nodes"]) == 1)
            # A bus that keeps 16 frames for a client gives its sender a window to match.
            a, b = server.attach(), server.attach()
            sent = 0
            while server.bus_stats()["nodes"][0]["overruns"] < 100:
                assert sent < 100_000, "the slow one never overran"
                await a.send(CanFrame(0x181, sent.to_bytes(4)))
                assert (await b.recv()).data == sent.to_bytes(4)
                sent += 1
            slow_node, a_node, b_node = server.bus_stats()["nodes"]
            assert (a_node["sent"], b_node["received"], b_node["overruns"]) == (sent, sent, 0)
            assert server.bus_stats()["overruns"] == slow_node["overruns"] >= 100
            # The received frames are complete and in order, with a gap where it overran.
            slow.settimeout(5)
            received = slow.recv(RECORD_SIZE, socket.MSG_WAITALL)
            assert unpack_hello(received) is not None
            last = -1
            for _ in range(10):
                frame, _ = unpack_record(slow.recv(RECORD_SIZE, socket.MSG_WAITALL))
                assert int.from_bytes(frame.data) == last + 1
                last += 1
            slow.close()

    run(main())


def test_an_attached_node_that_does_not_read_overruns_alone() -> None:
    async def main() -> None:
        async with bus(paced=False) as server:
            a, lazy = server.attach("a"), server.attach("lazy", max_pending=10)
            for i in range(30):
                await a.send(CanFrame(i))
            await eventually(lambda: server.bus_stats()["frames"] == 30)
            assert lazy.overruns == 20
            assert [n["overruns"] for n in server.bus_stats()["nodes"]] == [0, 20]
            assert [f.can_id for f in await take(lazy, 10)] == list(range(10))

    run(main())


@pytest.mark.parametrize("kind", ["plant", "emulator", "attached"])
def test_the_bus_closing_is_a_lost_connection_for_readers_and_senders(kind: str) -> None:
    async def main() -> None:
        async with bus(10_000, queue_frames=2) as server:
            end: CanConnection
            if kind == "plant":
                end = await SoftBusConnection.open(server.bound, 10_000)
            elif kind == "emulator":
                end = await open_can_end(server.bound, 10_000)
            else:
                end = server.attach()
            reading = asyncio.create_task(end.recv())
            for _ in range(2):
                await end.send(CanFrame(0x100, bytes(8)))
            blocked = asyncio.create_task(end.send(CanFrame(0x100, bytes(8))))
            also = asyncio.create_task(end.send(CanFrame(0x100, bytes(8))))
            await asyncio.sleep(0)
            await server.aclose()
            for task in (reading, blocked, also):
                with pytest.raises(ConnectionLost):
                    await task
            with pytest.raises(ConnectionLost):
                await end.send(CanFrame(1))
            with pytest.raises(ConnectionLost):
                await end.recv()
            await end.aclose()
            await end.aclose()

    run(main())


def test_frames_received_before_the_bus_closed_are_still_read() -> None:
    async def main() -> None:
        async with bus() as server:
            a, b = server.attach(), await SoftBusConnection.open(server.bound, 125_000)
            await a.send(CanFrame(0x42))
            await eventually(lambda: len(b.inbound.data_stream) == 1)
            await server.aclose()
            assert (await b.recv()).can_id == 0x42
            with pytest.raises(ConnectionLost):
                await b.recv()
            await b.aclose()

    run(main())


@pytest.mark.parametrize("opener", [SoftBusConnection.open, open_can_end])
def test_closing_right_after_sending_loses_nothing(opener) -> None:  # type: ignore[no-untyped-def]
    async def main() -> None:
        async with bus(50_000) as server:
            watch = server.attach()
            end = await opener(server.bound, 50_000)
            await watch.send(CanFrame(0x1))  # something unread in its socket
            for i in range(40):
                await end.send(CanFrame(0x100 + i))
            await end.aclose()
            with pytest.raises(ConnectionLost):
                await end.recv()
            assert [f.can_id for f in await take(watch, 40)] == list(range(0x100, 0x128))

    run(main())


@pytest.mark.parametrize("opener", [SoftBusConnection.open, open_can_end])
def test_a_refused_node_gets_a_typed_error(opener) -> None:  # type: ignore[no-untyped-def]
    async def main() -> None:
        async with bus(125_000, max_nodes=1) as server:
            with pytest.raises(UsageError, match=r"expected 250000 bit/s; got 125000 bit/s"):
                await opener(server.bound, 250_000)
            end = await opener(server.bound, 125_000)
            with pytest.raises(EndpointBusy):
                await opener(server.bound, 125_000)
            with pytest.raises(UsageError):
                await end.send(CanFrame(0x20, bytes(8), error=True))
            await end.aclose()
            assert server.bus_stats()["turned_away"] == 2
            bound = server.bound
        with pytest.raises(Unreachable, match=str(bound.address[1])):
            await opener(bound, 125_000)

    run(main())


@pytest.mark.parametrize("opener", [SoftBusConnection.open, open_can_end])
@pytest.mark.parametrize(
    "answer", [b"HTTP/1.1 400 Bad Request\r\n\r\n", b"", BusHello(125_000, status=2, version=9).pack()]
)
def test_a_different_program_listens_there(opener, answer: bytes) -> None:  # type: ignore[no-untyped-def]
    async def main() -> None:
        async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            await reader.read(100)
            writer.write(answer)
            writer.close()

        server = await asyncio.start_server(serve, "127.0.0.1", 0)
        port = server.sockets[0].getsockname()[1]
        with pytest.raises(Unreachable):
            await opener(Endpoint.parse(f"can:fieldtwin/127.0.0.1:{port}"), 125_000)
        server.close()
        await server.wait_closed()

    run(main())


BAD_HELLOS = [
    b"GET / HTTP/1.1\r\nHost: x\r\n\r\n",
    pack_record(CanFrame(1)),
    BusHello(0).pack() + pack_record(CanFrame(1), confirmed=True),
    BusHello(0).pack() + pack_record(CanFrame(0x20, bytes(8), error=True)),
    BusHello(0).pack() + b"\xff" * RECORD_SIZE,
]


@pytest.mark.parametrize("sent", BAD_HELLOS)
def test_a_client_that_breaks_the_protocol_is_dropped_alone(sent: bytes) -> None:
    async def main() -> None:
        async with bus() as server:
            good = await SoftBusConnection.open(server.bound, 125_000)
            _, writer = await asyncio.open_connection(*server.bound.address)
            writer.write(sent)
            await eventually(lambda: server.bus_stats()["turned_away"] == 1)
            await eventually(lambda: len(server.bus_stats()["nodes"]) == 1)
            writer.close()
            watch = server.attach()
            await good.send(CanFrame(0x7))
            assert (await watch.recv()).can_id == 0x7
            await good.aclose()

    run(main())


def test_a_different_version_gets_our_version() -> None:
    async def main() -> None:
        async with bus() as server:
            reader, writer = await asyncio.open_connection(*server.bound.address)
            writer.write(BusHello(125_000, version=FD_VERSION + 1).pack())
            answer = unpack_hello(await reader.readexactly(RECORD_SIZE))
            assert answer is not None
            assert (answer.status, answer.version) == (Status.UNKNOWN_VERSION, VERSION)
            assert await reader.read() == b""
            writer.close()

    run(main())


def test_a_port_in_use_and_another_kind_of_endpoint() -> None:
    async def main() -> None:
        async with bus() as server:
            with pytest.raises(EndpointBusy):
                await SoftBusServer.open(server.bound, 125_000)
        with pytest.raises(UsageError):
            await SoftBusServer.open(Endpoint.parse("can:socketcan/vcan0"), 125_000)
        with pytest.raises(UsageError):
            await open_can_end(Endpoint.parse("can:kvaser/0"), 125_000)

    run(main())


def test_closing_does_not_wait_for_a_client_that_never_reads() -> None:
    async def main() -> None:
        async with bus(paced=False) as server:
            deaf = socket.create_connection(server.bound.address)
            deaf.sendall(BusHello(0).pack())
            a = server.attach()
            await eventually(lambda: len(server.bus_stats()["nodes"]) == 2)
            for _ in range(2000):
                await a.send(CanFrame(0x55, bytes(8)))
            async with asyncio.timeout(5):
                await server.aclose()
            deaf.close()

    run(main())
