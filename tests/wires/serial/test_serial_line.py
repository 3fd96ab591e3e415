"""A real pty replaces a serial port; its limits (no parity on the wire, no DTR) are not tested here."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import os
import pty
import termios
import tty
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
from support import eventually, run

from fieldtwin.gateway.connections.serial import port as serial_port
from fieldtwin.gateway.connections.serial.line import SerialConnection
from fieldtwin.gateway.core.connection import RS232Connection
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import ConnectionLost, EndpointBusy, Unreachable


@dataclass
class Line:
    """The far side of a serial line: the master of a pty."""

    master: int
    path: str

    @property
    def endpoint(self) -> Endpoint:
        return Endpoint.parse(f"rtu:{self.path}?baudrate=9600&frame=8N2")

    def pull(self) -> None:
        """Pull the plug."""
        if self.master >= 0:
            os.close(self.master)
            self.master = -1

    def take(self) -> bytes:
        with contextlib.suppress(BlockingIOError):
            return os.read(self.master, 65536)
        return b""


@pytest.fixture
def line() -> Iterator[Line]:
    master, slave = pty.openpty()
    tty.setraw(slave)
    made = Line(master, os.ttyname(slave))
    os.set_blocking(master, False)
    os.close(slave)
    yield made
    made.pull()


async def collect(connection: SerialConnection, size: int) -> bytes:
    data = b""
    while len(data) < size:
        data += await connection.read()
    return data


def test_every_byte_value_passes_unchanged_in_both_directions(line: Line) -> None:
    # XON, XOFF, ^C, CR, NL and 0xFF are the characters that a badly configured line removes
    every = bytes(range(256)) * 3

    async def main() -> None:
        connection = await SerialConnection.open(line.endpoint)
        assert isinstance(connection.inbound, RS232Connection)
        os.write(line.master, every)
        assert await collect(connection, len(every)) == every
        await connection.write(every)
        got = b""

        def arrived() -> bool:
            nonlocal got
            got += line.take()
            return len(got) >= len(every)

        await eventually(arrived)
        assert got == every
        await connection.aclose()

    run(main())


def test_bytes_from_before_the_opening_of_the_line_are_discarded(line: Line) -> None:
    async def main() -> None:
        os.write(line.master, b"a reply to somebody else")
        connection = await SerialConnection.open(line.endpoint)
        os.write(line.master, b"fresh")
        assert await connection.read() == b"fresh"
        await connection.aclose()

    run(main())


def test_a_wake_up_without_data_is_not_a_hang_up(line: Line) -> None:
    async def main() -> None:
        connection = await SerialConnection.open(line.endpoint)
        connection._on_readable()  # as after a flush by the driver between poll and read
        assert connection.lost is None
        os.write(line.master, b"x")
        assert await connection.read() == b"x"
        await connection.aclose()

    run(main())


def test_baud_rate_and_frame_reach_the_port(line: Line) -> None:
    async def main() -> None:
        connection = await SerialConnection.open(line.endpoint)
        attributes = termios.tcgetattr(line.master)
        assert attributes[4] == attributes[5] == termios.B9600
        assert attributes[2] & termios.CSTOPB
        assert connection.ignored == ()
        await connection.aclose()

    run(main())


def test_a_parity_that_the_driver_does_not_apply_is_reported(line: Line) -> None:
    async def main() -> None:
        connection = await SerialConnection.open(Endpoint.parse(f"rtu:{line.path}?frame=8E1"))
        assert connection.ignored == ("parity E",)
        await connection.aclose()

    run(main())


def test_no_such_port_lists_those_that_exist(monkeypatch: pytest.MonkeyPatch) -> None:
    async def main() -> None:
        with pytest.raises(Unreachable) as caught:
            await SerialConnection.open(Endpoint.parse("rtu:/dev/ttyNOTHERE7"))
        assert "no such serial port" in str(caught.value)
        assert "/dev/ttyNOTHERE7" in caught.value.where
        assert "ports here" in caught.value.hint or "no serial port" in caught.value.hint

    run(main())


@pytest.mark.parametrize("path", ["/dev/null", "/tmp"])
def test_a_file_that_is_not_a_serial_port_is_unreachable(path: str) -> None:
    async def main() -> None:
        with pytest.raises(Unreachable):
            await SerialConnection.open(Endpoint.parse(f"rtu:{path}"))

    run(main())


def test_permission_denied_names_the_group(tmp_path: Path) -> None:
    error = serial_port._cannot_open(Endpoint.parse("rtu:/dev/ttyS0"), errno.EACCES, "")
    assert isinstance(error, Unreachable)
    assert "no permission" in str(error)
    port = tmp_path / "port"
    port.touch()
    port.chmod(0o600)
    assert "only its owner" in serial_port._group_hint(str(port))
    port.chmod(0o660)
    os.chown(port, -1, _some_group())
    assert "usermod -aG" in serial_port._group_hint(str(port)) or _some_group() == 0


def _some_group() -> int:
    """Return a group to which this process may assign a file, preferably not root's."""
    return 20 if os.getuid() == 0 else os.getgid()


def test_a_second_opener_gets_an_error_that_the_port_is_held(line: Line) -> None:  # MB-067
    async def main() -> None:
        first = await SerialConnection.open(line.endpoint)
        with pytest.raises(EndpointBusy, match="another program"):
            await SerialConnection.open(line.endpoint)
        await first.aclose()
        await (await SerialConnection.open(line.endpoint)).aclose()

    run(main())


def test_unplugging_gives_received_bytes_and_then_the_loss(line: Line) -> None:  # MB-066
    async def main() -> None:
        connection = await SerialConnection.open(line.endpoint)
        os.write(line.master, b"last words")
        await eventually(lambda: bool(connection.inbound.data_stream))
        line.pull()
        await eventually(lambda: connection.lost is not None)
        assert await connection.read() == b"last words"
        with pytest.raises(ConnectionLost, match="serial port is gone"):
            await connection.read()
        with pytest.raises(ConnectionLost):
            await connection.write(b"x")
        with pytest.raises(OSError):  # closed at once: an open descriptor would keep the port's name in use
            os.fstat(connection._fd)
        await connection.aclose()

    run(main())


def test_unplugged_wakes_a_reader_and_a_writer_that_wait(line: Line) -> None:
    async def main() -> None:
        connection = await SerialConnection.open(line.endpoint)
        reading = asyncio.create_task(connection.read())
        writing = asyncio.create_task(connection.write(bytes(1 << 20)))
        await eventually(lambda: connection._room is not None)
        line.pull()
        for task in (reading, writing):
            with pytest.raises(ConnectionLost):
                await task

    run(main())


def test_a_write_waits_while_the_driver_is_full_and_loses_nothing(line: Line) -> None:
    sent = bytes(n % 251 for n in range(200_000))

    async def main() -> None:
        connection = await SerialConnection.open(line.endpoint)
        first = asyncio.create_task(connection.write(sent[:100_000]))
        second = asyncio.create_task(connection.write(sent[100_000:]))
        await eventually(lambda: connection._room is not None)
        assert not first.done()
        got = bytearray()

        def all_arrived() -> bool:
            got.extend(line.take())
            return len(got) >= len(sent)

        await eventually(all_arrived)
        await first
        await second
        assert got == sent
        await connection.aclose()

    run(main())


def test_a_slow_reader_throttles_the_line_and_loses_nothing(line: Line) -> None:
    sent = bytes(n % 251 for n in range(300_000))

    async def main() -> None:
        connection = await SerialConnection.open(line.endpoint, max_pending=4)
        rest = memoryview(sent)
        most = 0
        got = bytearray()
        idle = 0
        while len(got) < len(sent):
            before = len(rest)
            with contextlib.suppress(BlockingIOError):
                rest = rest[os.write(line.master, rest) :] if rest else rest
            await asyncio.sleep(0)
            most = max(most, len(connection.inbound.data_stream))
            idle = 0 if len(rest) < before else idle + 1
            if idle > 20:  # the line is full: now read one chunk
                got += await asyncio.wait_for(connection.read(), 5)
                idle = 0
        assert got == sent
        assert most <= 4
        await connection.aclose()

    run(main())


def test_closing_lets_the_last_bytes_leave_and_is_idempotent(line: Line) -> None:
    async def main() -> None:
        connection = await SerialConnection.open(line.endpoint)
        await connection.write(b"safe value")
        await connection.aclose()
        await connection.aclose()
        with pytest.raises(ConnectionLost, match="closed on this side"):
            await connection.read()
        with pytest.raises(ConnectionLost):
            await connection.write(b"x")
        assert line.take() == b"safe value"

    run(main())


def test_an_opening_that_is_cancelled_leaves_the_port_free(line: Line) -> None:
    async def main() -> None:
        opening = asyncio.create_task(SerialConnection.open(line.endpoint))
        await asyncio.sleep(0)
        opening.cancel()
        with pytest.raises(asyncio.CancelledError):
            await opening

        async def free() -> bool:
            try:
                await (await SerialConnection.open(line.endpoint)).aclose()
            except EndpointBusy:
                return False
            return True

        await eventually(free)

    run(main())
