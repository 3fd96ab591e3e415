"""The plant's Connector and its taps, on a real pty and a real socket."""

from __future__ import annotations

import asyncio
import json
import os
import pty
import tty
from pathlib import Path

import pytest
from support import eventually, run

from fieldtwin.emulators.endpoints.can.bus_server import SoftBusServer
from fieldtwin.gateway.connections.os_connector import OsConnector
from fieldtwin.gateway.connections.serial.line import SerialConnection
from fieldtwin.gateway.connections.sockets.tcp import TcpConnection
from fieldtwin.gateway.connections.tap import CaptureTap, TapFile, TappedConnector
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.connection import ByteConnection, CANConnection, CanConnection, Connector, Direction
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import ConnectionLost, FileInvalid, Unreachable, UsageError
from fieldtwin.gateway.wallclock import WallClock


def test_the_scheme_decides_which_end_opens() -> None:
    async def main() -> None:
        connector: Connector = OsConnector()
        master, slave = pty.openpty()
        tty.setraw(slave)
        path = os.ttyname(slave)
        os.close(slave)
        for scheme in ("rtu", "ascii"):
            serial = await connector.open_bytes(Endpoint.parse(f"{scheme}:{path}?frame=8N1"))
            assert isinstance(serial, SerialConnection)
            await serial.aclose()
        os.close(master)
        server = await asyncio.start_server(lambda r, w: w.close(), "127.0.0.1", 0)
        port = server.sockets[0].getsockname()[1]
        for scheme in ("tcp", "rtu+tcp"):
            stream = await connector.open_bytes(Endpoint.parse(f"{scheme}://127.0.0.1:{port}"))
            assert isinstance(stream, TcpConnection)
            await stream.aclose()
        server.close()
        await server.wait_closed()

    run(main())


@pytest.mark.parametrize(
    ("url", "says"),
    [
        ("can:socketcan/can0", "frames"),
        ("pty:line1", "listening side"),
    ],
)
def test_an_endpoint_without_a_byte_stream_is_a_usage_error(url: str, says: str) -> None:
    async def main() -> None:
        with pytest.raises(UsageError, match=says):
            await OsConnector().open_bytes(Endpoint.parse(url))

    run(main())


def test_an_endpoint_that_is_not_a_can_bus_or_an_unknown_interface_is_a_usage_error() -> None:
    async def main() -> None:
        with pytest.raises(UsageError, match="not a CAN bus"):
            await OsConnector().open_can(Endpoint.parse("tcp://h:1"), 125_000)
        with pytest.raises(UsageError, match="pcan"):
            await OsConnector().open_can(Endpoint.parse("can:pcan/usb1"), 125_000)

    run(main())


def test_a_software_can_bus_is_joined_and_tapped() -> None:
    async def main() -> None:
        server = await SoftBusServer.open(Endpoint.parse("can:fieldtwin/127.0.0.1:0"), 125_000)
        capture = CaptureTap()
        connector = TappedConnector(OsConnector(), [capture], WallClock())
        a = await connector.open_can(server.bound, 125_000)
        b = await OsConnector().open_can(server.bound, 125_000)
        await a.send(CanFrame(0x605, b"\x40"))
        assert (await b.recv()).key() == CanFrame(0x605, b"\x40").key()
        await b.send(CanFrame(0x585, b"\x43"))
        assert (await a.recv()).key() == CanFrame(0x585, b"\x43").key()
        assert [(c.direction.value, str(c.item)) for c in capture.captured] == [
            ("sent", "605#40"),
            ("received", "585#43"),
        ]
        await a.aclose()
        await b.aclose()
        await server.aclose()
        with pytest.raises(Unreachable):
            await connector.open_can(server.bound, 125_000)

    run(main())


class Echo:
    """A TCP server that first sends a greeting and then echoes."""

    async def __aenter__(self) -> Endpoint:
        self._ended = asyncio.Event()
        self._server = await asyncio.start_server(self._serve, "127.0.0.1", 0)
        return Endpoint("tcp", host="127.0.0.1", port=self._server.sockets[0].getsockname()[1])

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(b"hello")
        while data := await reader.read(100):
            writer.write(data)
        writer.close()
        self._ended.set()

    async def __aexit__(self, *_: object) -> None:
        self._server.close()
        await self._server.wait_closed()
        await self._ended.wait()


class Mapped(Connector):
    """Open an endpoint that differs from the requested one, as a prototype does."""

    def __init__(self, target: Endpoint) -> None:
        self.target = target

    async def open_bytes(self, endpoint: Endpoint) -> ByteConnection:
        return await OsConnector().open_bytes(self.target)

    async def open_can(self, endpoint: Endpoint, bitrate: int) -> CanConnection:
        return LoopedCan(endpoint)


class LoopedCan(CanConnection):
    """A bus with one other node, which answers every frame with the next identifier."""

    def __init__(self, endpoint: Endpoint) -> None:
        super().__init__(CANConnection(), endpoint, max_pending=2)

    async def send(self, frame: CanFrame) -> None:
        self.feed(CanFrame(frame.can_id + 1, frame.data))

    async def aclose(self) -> None:
        self.feed_lost(ConnectionLost("closed"))


PLANT = Endpoint.parse("tcp://modem:502")
PLANT_CAN = Endpoint.parse("can:socketcan/can0")


def test_taps_see_every_byte_in_both_directions_under_the_plants_endpoint(tmp_path: Path) -> None:
    async def main() -> None:
        capture, file = CaptureTap(), TapFile(tmp_path / "capture.jsonl")
        async with Echo() as target:
            connector = TappedConnector(Mapped(target), [capture, file], WallClock())
            connection = await connector.open_bytes(PLANT)
            await eventually(
                lambda: capture.stream(PLANT, Direction.RECEIVED) == b"hello", what="seen before it is read"
            )
            assert await connection.read() == b"hello"
            await connection.write(b"\x01\x02")
            await eventually(lambda: capture.stream(PLANT, Direction.RECEIVED) == b"hello\x01\x02")
            assert connection.read_pending() == b"\x01\x02"
            assert capture.stream(PLANT, Direction.SENT) == b"\x01\x02"
            await connection.aclose()
            with pytest.raises(ConnectionLost):
                await connection.write(b"never")
            assert connection.lost is not None
        file.close()
        assert capture.stream(PLANT, Direction.SENT) == b"\x01\x02"
        lines = [json.loads(text) for text in (tmp_path / "capture.jsonl").read_text().splitlines()]
        assert [(line["endpoint"], line["direction"], line["hex"]) for line in lines] == [
            ("tcp://modem:502", "received", b"hello".hex()),
            ("tcp://modem:502", "sent", "0102"),
            ("tcp://modem:502", "received", "0102"),
        ]
        assert [line["t_ns"] for line in lines] == [c.t_ns for c in capture.captured]
        assert [line["t_ns"] for line in lines] == sorted(line["t_ns"] for line in lines)

    run(main())


def test_taps_see_frames_and_overruns_stay_visible(tmp_path: Path) -> None:
    async def main() -> None:
        capture, file = CaptureTap(), TapFile(tmp_path / "capture.jsonl")
        connector = TappedConnector(Mapped(PLANT), [capture, file], WallClock())
        bus = await connector.open_can(PLANT_CAN, 125_000)
        for n in range(3):  # the bus end keeps two: the third answer is dropped there
            await bus.send(CanFrame(0x605, bytes([n])))
        assert bus.overruns == 1
        assert (await bus.recv()).key() == CanFrame(0x606, b"\0").key()
        await bus.aclose()
        file.close()
        seen = [(c.direction.value, str(c.item)) for c in capture.captured]
        assert seen == [
            ("received", "606#00"),
            ("sent", "605#00"),
            ("received", "606#01"),
            ("sent", "605#01"),
            ("sent", "605#02"),
        ]
        lines = [json.loads(text) for text in (tmp_path / "capture.jsonl").read_text().splitlines()]
        assert [(line["direction"], line["frame"], line["hex"]) for line in lines] == [
            (direction, text, text[4:]) for direction, text in seen
        ]

    run(main())


def test_a_tapped_connector_may_be_tapped_again() -> None:
    async def main() -> None:
        near, far = CaptureTap(), CaptureTap()
        async with Echo() as target:
            connector = TappedConnector(TappedConnector(Mapped(target), [far], WallClock()), [near], WallClock())
            connection = await connector.open_bytes(PLANT)
            await connection.write(b"x")
            await eventually(lambda: near.stream(PLANT, Direction.RECEIVED) == b"hellox")
            assert far.stream(PLANT, Direction.RECEIVED) == b"hellox"
            assert near.stream(PLANT, Direction.SENT) == far.stream(PLANT, Direction.SENT) == b"x"
            await connection.aclose()
        bus = await connector.open_can(PLANT_CAN, 125_000)
        await bus.send(CanFrame(0x605))
        assert [str(c.item) for c in near.captured[-2:]] == [str(c.item) for c in far.captured[-2:]] == ["606#", "605#"]
        await bus.aclose()

    run(main())


class Broken(CaptureTap):
    def on_bytes(self, endpoint: Endpoint, direction: Direction, t_ns: int, data: bytes) -> None:
        raise ValueError("a tap with a bug")


def test_a_failing_tap_is_removed_and_reported_and_affects_nothing_else() -> None:
    async def main() -> None:
        reports: list[str] = []
        asyncio.get_running_loop().set_exception_handler(lambda _, context: reports.append(context["message"]))
        healthy = CaptureTap()
        async with Echo() as target:
            connector = TappedConnector(Mapped(target), [Broken(), healthy], WallClock())
            connection = await connector.open_bytes(PLANT)
            await connection.write(b"x")
            await eventually(lambda: healthy.stream(PLANT, Direction.RECEIVED) == b"hellox")
            assert (await connection.read()).startswith(b"hello")
            await connection.aclose()
        assert connector.failed_taps == 1
        assert len(reports) == 1
        assert "was removed" in reports[0]

    run(main())


def test_a_capture_is_bounded_and_counts_dropped_entries(tmp_path: Path) -> None:
    capture = CaptureTap(capacity=3)
    file = TapFile(tmp_path / "capture.jsonl", max_bytes=200)
    for n in range(5):
        capture.on_bytes(PLANT, Direction.SENT, n, bytes([n]))
        file.on_bytes(PLANT, Direction.SENT, n, bytes([n]))
    assert capture.stream(PLANT, Direction.SENT) == b"\2\3\4"
    assert capture.dropped == 2
    written = (tmp_path / "capture.jsonl").read_text()  # before it is closed: a crash would leave the same
    assert len(written) <= 200
    assert file.dropped == 5 - len(written.splitlines()) > 0
    file.close()
    file.close()
    file.on_bytes(PLANT, Direction.SENT, 9, b"late")
    assert (tmp_path / "capture.jsonl").read_text() == written


def test_a_full_disk_ends_the_capture_and_not_the_run() -> None:
    file = TapFile(Path("/dev/full"))
    file.on_bytes(PLANT, Direction.SENT, 1, b"x")
    file.on_bytes(PLANT, Direction.SENT, 2, b"x")
    assert file.dropped == 2
    assert file.error is not None


def test_an_unwritable_capture_is_reported_at_start(tmp_path: Path) -> None:
    with pytest.raises(FileInvalid, match="cannot write the capture"):
        TapFile(tmp_path / "no" / "such" / "folder")


def test_a_tapped_connector_passes_on_that_the_device_is_missing() -> None:
    async def main() -> None:
        connector = TappedConnector(OsConnector(), [], WallClock())
        with pytest.raises(Unreachable):
            await connector.open_bytes(Endpoint.parse("rtu:/dev/ttyNOTHERE"))

    run(main())
