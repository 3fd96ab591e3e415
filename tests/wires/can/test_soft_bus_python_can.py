"""The software bus as an interface of python-can: programs without knowledge of fieldtwin join it."""

from __future__ import annotations

import asyncio
import os
import signal
import sys
import time
import tomllib
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import can
import canopen
import pytest
from support import eventually, run

from fieldtwin.emulators.endpoints.can.bus_hello import BusHello, unpack_hello
from fieldtwin.emulators.endpoints.can.bus_server import SoftBusServer
from fieldtwin.gateway.connections.soft_bus import SoftBus
from fieldtwin.gateway.core.canframe import RECORD_SIZE, CanFrame, pack_record
from fieldtwin.gateway.core.endpoint import Endpoint

ROOT = Path(__file__).parents[3]


@asynccontextmanager
async def bus(bitrate: int = 125_000, **options: object) -> AsyncIterator[SoftBusServer]:
    server = await SoftBusServer.open(Endpoint.parse("can:fieldtwin/127.0.0.1:0"), bitrate, **options)  # type: ignore[arg-type]
    try:
        yield server
    finally:
        await server.aclose()


async def join(server: SoftBusServer, **options: object) -> SoftBus:
    host, port = server.bound.address
    return await asyncio.to_thread(SoftBus, f"{host}:{port}", **options)


async def leave(*buses: SoftBus) -> None:
    for each in buses:
        await asyncio.to_thread(each.shutdown)


def test_frames_of_every_kind_there_and_back() -> None:
    async def main() -> None:
        async with bus() as server:
            a, b = await join(server), await join(server, bitrate=125_000, receive_own_messages=True)
            before = time.time()
            messages = [
                can.Message(arbitration_id=0x123, is_extended_id=False, data=b"\x01\x02"),
                can.Message(arbitration_id=0x1234567, is_extended_id=True, data=bytes(8)),
                can.Message(arbitration_id=0x605, is_extended_id=False, is_remote_frame=True, dlc=8),
            ]
            for message in messages:
                await asyncio.to_thread(a.send, message, 1.0)
            for message in messages:
                got = await asyncio.to_thread(b.recv, 5.0)
                assert got is not None
                assert got.equals(message, timestamp_delta=None, check_channel=False)
                assert before - 0.001 <= got.timestamp <= time.time() + 0.001
            await asyncio.to_thread(b.send, messages[0])
            own = await asyncio.to_thread(b.recv, 5.0)
            assert own is not None
            assert not own.is_rx
            heard = await asyncio.to_thread(a.recv, 5.0)
            assert heard is not None
            assert heard.is_rx
            assert heard.timestamp == pytest.approx(own.timestamp, abs=0.005)
            assert await asyncio.to_thread(a.recv, 0) is None, "without receive_own_messages nothing comes back"
            await leave(a, b)

    run(main())


def test_a_burst_of_100_frames_arrives_whole_through_a_notifier_on_the_loop() -> None:
    async def main() -> None:
        async with bus(paced=False) as server:
            a, b = await join(server), await join(server)
            got: list[int] = []
            notifier = can.Notifier(b, [lambda m: got.append(m.arbitration_id)], loop=asyncio.get_running_loop())
            for i in range(100):
                a.send(can.Message(arbitration_id=i, is_extended_id=False))
            await eventually(lambda: len(got) == 100)
            assert got == list(range(100))
            notifier.stop()
            await leave(a, b)

    run(main())


def test_one_record_a_recv_leaves_the_descriptor_readable() -> None:
    async def main() -> None:
        async with bus(paced=False) as server:
            a, b = server.attach(), await join(server)
            for i in range(3):
                await a.send(CanFrame(i))
            await eventually(lambda: server.bus_stats()["frames"] == 3)
            readable = asyncio.Event()
            for i in range(3):
                asyncio.get_running_loop().add_reader(b.fileno(), readable.set)
                await readable.wait()
                asyncio.get_running_loop().remove_reader(b.fileno())
                readable.clear()
                message = b.recv(0)
                assert message is not None
                assert message.arbitration_id == i
            await leave(b)
            assert b.fileno() == -1

    run(main())


def test_can_filters_select_received_frames() -> None:
    async def main() -> None:
        async with bus(paced=False) as server:
            a = server.attach()
            b = await join(server, can_filters=[{"can_id": 0x700, "can_mask": 0x780, "extended": False}])
            for can_id in (0x181, 0x705, 0x281, 0x77F):
                await a.send(CanFrame(can_id))
            got = [await asyncio.to_thread(b.recv, 5.0) for _ in range(2)]
            assert [m.arbitration_id for m in got if m] == [0x705, 0x77F]
            await leave(b)

    run(main())


def test_periodic_sending_until_it_is_stopped() -> None:
    async def main() -> None:
        async with bus() as server:
            a, other = await join(server), server.attach("other")
            task = a.send_periodic(can.Message(arbitration_id=0x80, is_extended_id=False), 0.01)
            times = [(await other.recv()).t_ns for _ in range(20)]
            task.stop()
            assert times == sorted(times)
            assert (
                times[-1] - times[0]
            ) / 1e9 > 0.1  # 19 periods; a loaded computer stretches them, but never shortens them
            await leave(a)
            await other.aclose()

    run(main())


def test_error_frames_and_records_cut_anywhere() -> None:
    error = CanFrame(0x4, b"\0\x20" + bytes(6), error=True, t_ns=1)
    frames = [error, CanFrame(0x12, b"x", t_ns=2)]

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        assert unpack_hello(await reader.readexactly(RECORD_SIZE)) is not None
        for byte in BusHello(125_000, window=1).pack() + b"".join(pack_record(f) for f in frames):
            writer.write(bytes([byte]))
            await writer.drain()
            await asyncio.sleep(0)
        await reader.read()
        writer.close()

    async def main() -> None:
        server = await asyncio.start_server(serve, "127.0.0.1", 0)
        b = await asyncio.to_thread(SoftBus, f"127.0.0.1:{server.sockets[0].getsockname()[1]}")
        got = [await asyncio.to_thread(b.recv, 5.0) for _ in range(2)]
        assert got[0] is not None
        assert got[1] is not None
        assert (got[0].is_error_frame, got[0].arbitration_id, bytes(got[0].data)) == (True, 0x4, error.data)
        assert (got[1].is_error_frame, got[1].arbitration_id) == (False, 0x12)
        await leave(b)
        server.close()
        await server.wait_closed()

    run(main())


def test_the_last_frame_is_not_lost_by_leaving() -> None:
    async def main() -> None:
        async with bus(50_000) as server:
            watch, a = server.attach(), await join(server)
            for _ in range(5):
                await watch.send(CanFrame(0x1))  # not read by a
            for i in range(200):
                await asyncio.to_thread(a.send, can.Message(arbitration_id=0x100 + i, is_extended_id=False))
            await leave(a)
            assert [(await watch.recv()).can_id for _ in range(200)] == list(range(0x100, 0x1C8))

    run(main())


def test_a_send_that_the_bus_does_not_take_times_out_and_is_not_sent() -> None:
    async def main() -> None:
        async with bus(100, queue_frames=1) as server:  # 1 s per frame: no frame is accepted for a while
            a = await join(server)

            def flood() -> int:
                for i in range(1_000_000):
                    try:
                        a.send(can.Message(arbitration_id=0x1, is_extended_id=False, data=i.to_bytes(4)), timeout=0)
                    except can.CanTimeoutError:
                        return i
                raise AssertionError("the bus took a million frames")

            # At most the content of the sockets can be in transit: some hundred frames, not minutes of them.
            assert 1 < await asyncio.to_thread(flood) < 500
            assert server.bus_stats()["nodes"][0]["queued"] == 1
            await leave(a)

    run(main())


def test_refusals_are_python_cans() -> None:
    async def main() -> None:
        async with bus() as server:
            with pytest.raises(can.CanInitializationError, match="expected 250000 bit/s; got 125000 bit/s"):
                await join(server, bitrate=250_000)
            with pytest.raises(can.CanInitializationError):
                await join(server, data_bitrate=2_000_000)
            a = await join(server)
            for bad in (
                can.Message(is_error_frame=True),
                can.Message(is_fd=True, data=bytes(12)),
                can.Message(arbitration_id=0x800, is_extended_id=False),
            ):
                with pytest.raises(can.CanOperationError):
                    a.send(bad)
            host, port = server.bound.address
            await server.aclose()
            with pytest.raises(can.CanOperationError, match="closed"):
                await asyncio.to_thread(a.recv, 5.0)
            await leave(a)
            await leave(a)
        for channel in (f"{host}:{port}", "nowhere"):
            with pytest.raises(can.CanInitializationError):
                await asyncio.to_thread(SoftBus, channel)

    run(main())


def test_canopen_network_over_the_bus() -> None:
    async def main() -> None:
        async with bus() as server:
            node, master = server.attach("node 5"), canopen.Network(await join(server))
            await asyncio.to_thread(master.connect)
            got: list[bytes] = []
            master.subscribe(0x705, lambda can_id, data, timestamp: got.append(bytes(data)))
            await node.send(CanFrame(0x705, b"\0"))
            await eventually(lambda: got == [b"\0"])
            await asyncio.to_thread(master.nmt.send_command, 1)
            assert (await node.recv()).key() == CanFrame(0x000, b"\1\0").key()
            await asyncio.to_thread(master.disconnect)

    run(main())


def test_can_logger_of_python_can_joins_by_entry_point(tmp_path: Path) -> None:
    # The entry point as pyproject.toml declares it, where an uninstalled checkout lets python-can find it.
    declared = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["entry-points"]["can.interface"]
    info = tmp_path / "fieldtwin_checkout-0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: fieldtwin-checkout\nVersion: 0\n")
    (info / "entry_points.txt").write_text(
        "[can.interface]\n" + "".join(f"{name} = {target}\n" for name, target in declared.items())
    )

    async def main() -> None:
        async with bus() as server:
            host, port = server.bound.address
            logger = await asyncio.create_subprocess_exec(
                *(sys.executable, "-m", "can.logger", "-i", "fieldtwin", "-c", f"{host}:{port}", "-b", "125000"),
                stdout=asyncio.subprocess.PIPE,
                stderr=asyncio.subprocess.STDOUT,
                env={**os.environ, "PYTHONPATH": f"{tmp_path}:{ROOT}", "PYTHONUNBUFFERED": "1"},
                cwd=tmp_path,
            )
            assert logger.stdout is not None
            try:
                node = server.attach()
                await eventually(lambda: len(server.bus_stats()["nodes"]) == 2, within_s=15)
                await node.send(CanFrame(0x705, b"\x05"))
                await node.send(CanFrame(0x1ABCDEF, b"\xca\xfe", extended=True))
                text = b""
                while b"ca fe" not in text:
                    line = await logger.stdout.readline()
                    assert line, text
                    text += line.lower()
                assert b"705" in text
                assert b"01abcdef" in text
            finally:
                logger.send_signal(signal.SIGINT)
                rest, _ = await logger.communicate()
            assert logger.returncode == 0, rest

    run(main(), timeout_s=30)
