"""A virtual serial port from its other side: through the operating system, opened by path."""

from __future__ import annotations

import asyncio
import os
import termios
from pathlib import Path

import pytest
from support import eventually, run

from fieldtwin.emulators.endpoints.pty import PtyEnd
from fieldtwin.emulators.wires.serial_line import SerialPacer
from fieldtwin.gateway.core.connection import PROTOCOL
from fieldtwin.gateway.core.endpoint import Endpoint, SerialSettings
from fieldtwin.gateway.core.errors import ConnectionLost, EndpointBusy, Unreachable

LINE = Endpoint.parse("pty:line1")


def open_port(path: Path) -> int:
    """Open the port like a program that expects it to be raw already."""
    return os.open(path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)


async def take(port: int, count: int, within_s: float = 5.0) -> bytes:
    data = bytearray()

    def more() -> bool:
        try:
            data.extend(os.read(port, 65536))
        except BlockingIOError:
            pass
        return len(data) >= count

    await eventually(more, within_s, f"{count} bytes")
    return bytes(data)


async def received(end: PtyEnd, count: int) -> bytes:
    data = b""
    while len(data) < count:
        async with asyncio.timeout(5):
            data += await end.read()
    return data


def test_all_bytes_pass_unchanged_in_both_directions(tmp_path: Path) -> None:
    async def main() -> None:
        end = await PtyEnd.open(tmp_path / "line1", LINE)
        port = open_port(tmp_path / "line1")
        everything = bytes(range(256)) * 2
        try:
            os.write(port, everything)
            assert await received(end, 512) == everything
            await end.write(everything)
            assert await take(port, 512) == everything
            assert end.read_pending() == b"", "something was echoed"
            assert end.type is PROTOCOL.RS232
        finally:
            os.close(port)
            await end.aclose()

    run(main())


def test_it_survives_the_other_side_closing_and_reopening(tmp_path: Path) -> None:
    async def main() -> None:
        end = await PtyEnd.open(tmp_path / "line1", LINE)
        for turn in range(5):
            port = open_port(tmp_path / "line1")
            os.write(port, b"ask%d" % turn)
            assert await received(end, 4) == b"ask%d" % turn
            await end.write(b"answer%d" % turn)
            assert await take(port, 7) == b"answer%d" % turn
            os.close(port)
        assert end.lost is None
        await end.aclose()

    run(main())


def open_with_parity(path: Path) -> int:
    """Open the port the way libmodbus and pyserial do for 19200 8E1."""
    port = open_port(path)
    settings = termios.tcgetattr(port)
    settings[0] = settings[1] = 0
    settings[2] = termios.CS8 | termios.CREAD | termios.CLOCAL | termios.PARENB
    settings[3] &= ~(termios.ICANON | termios.ECHO | termios.ECHOE | termios.ISIG)
    settings[4] = settings[5] = termios.B19200
    try:
        termios.tcsetattr(port, termios.TCSANOW, settings)
    except termios.error:
        os.close(port)
        raise
    return port


def test_it_can_be_opened_with_parity_again_and_again(tmp_path: Path) -> None:
    """Debian's tcsetattr refuses parity on a pty unless something else changes too."""

    async def main() -> None:
        end = await PtyEnd.open(tmp_path / "line1", LINE, SerialSettings(19200, "8E1"))
        for turn in range(3):
            port = open_with_parity(tmp_path / "line1")
            os.write(port, b"\x04%d\n" % turn)  # characters that a terminal in canonical mode would eat
            assert await received(end, 3) == b"\x04%d\n" % turn
            await end.write(b"\x11\n\r")
            assert await take(port, 3) == b"\x11\n\r"
            os.close(port)

        def opens() -> bool:
            try:
                os.close(open_with_parity(tmp_path / "line1"))
            except termios.error:
                return False
            return True

        for _ in range(2):  # programs that open it and send nothing
            await eventually(opens, within_s=2)
        await end.aclose()

    run(main())


def test_the_link_is_replaced_and_removed_only_by_its_owner(tmp_path: Path) -> None:
    async def main() -> None:
        link = tmp_path / "line1"
        link.symlink_to("/dev/pts/none")  # left by a killed process
        first = await PtyEnd.open(link, LINE)
        assert os.readlink(link) == first.device
        second = await PtyEnd.open(link, LINE)
        await first.aclose()
        assert os.readlink(link) == second.device, "another one's link was removed"
        await second.aclose()
        assert list(tmp_path.iterdir()) == []
        await second.aclose()

    run(main())


def test_a_file_in_the_way_is_kept(tmp_path: Path) -> None:
    async def main() -> None:
        (tmp_path / "line1").write_text("precious")
        with pytest.raises(EndpointBusy, match="line1"):
            await PtyEnd.open(tmp_path / "line1", LINE)
        assert (tmp_path / "line1").read_text() == "precious"
        before = len(os.listdir("/proc/self/fd"))
        with pytest.raises(Unreachable, match="cannot make the link"):
            await PtyEnd.open(tmp_path / "nowhere" / "line1", LINE)
        assert len(os.listdir("/proc/self/fd")) == before, "a descriptor leaked"

    run(main())


def test_closing_wakes_waiting_readers(tmp_path: Path) -> None:
    async def main() -> None:
        end = await PtyEnd.open(tmp_path / "line1", LINE)
        reading = asyncio.create_task(end.read())
        writing = asyncio.create_task(end.write(bytes(1_000_000)))  # no program reads: this waits
        await eventually(lambda: end._room is not None)
        await end.aclose()
        for task in (reading, writing):
            with pytest.raises(ConnectionLost):
                await task
        with pytest.raises(ConnectionLost):
            await end.write(b"x")

    run(main())


def test_a_flood_is_throttled_and_nothing_is_lost(tmp_path: Path) -> None:
    async def main() -> None:
        end = await PtyEnd.open(tmp_path / "line1", LINE)
        end.max_pending = 4
        port = open_port(tmp_path / "line1")
        sent = 0

        def stuck() -> bool:
            nonlocal sent
            try:
                sent += os.write(port, bytes(i & 0xFF for i in range(sent, sent + 1000)))
            except BlockingIOError:
                return len(end.inbound.data_stream) >= 4
            return False

        await eventually(stuck, what="the flood is held back")
        assert len(end.inbound.data_stream) == 4
        assert await received(end, sent) == bytes(i & 0xFF for i in range(sent))
        os.close(port)
        await end.aclose()

    run(main())


def test_writing_continues_after_the_other_side_flushed(tmp_path: Path) -> None:
    """A client that opens the port discards its content; a writer that waits for room must notice."""

    async def main() -> None:
        end = await PtyEnd.open(tmp_path / "line1", LINE)
        writing = asyncio.create_task(end.write(bytes(20_000) + b"the end"))
        await eventually(lambda: end._room is not None)
        port = open_port(tmp_path / "line1")
        termios.tcflush(port, termios.TCIFLUSH)
        last = b""
        while not last.endswith(b"the end"):
            last = last[-10:] + await take(port, 1)
        await writing
        os.close(port)
        await end.aclose()

    run(main())


@pytest.mark.parametrize("settings", [SerialSettings(19200, "8E1"), SerialSettings(9600, "8N1")])
def test_a_paced_reply_takes_the_time_of_the_line(tmp_path: Path, settings: SerialSettings) -> None:
    async def main() -> None:
        loop = asyncio.get_running_loop()
        end = await PtyEnd.open(tmp_path / "line1", LINE, settings)
        port = open_port(tmp_path / "line1")
        line = SerialPacer(settings)
        for _ in range(3):
            asked_s = loop.time()
            os.write(port, b"12345678")
            assert await received(end, 8) == b"12345678"
            await end.write(bytes(range(40)))
            took_s = loop.time() - asked_s
            assert await take(port, 40) == bytes(range(40))
            least_s = (line.duration_ns(48) + line.t3_5_ns) / 1e9
            assert took_s >= least_s - 1e-6, "faster than the line"
            assert took_s < least_s + 1.0
        os.close(port)
        await end.aclose()

    run(main())


def test_bytes_are_readable_when_the_line_has_carried_them(tmp_path: Path) -> None:
    """A device starts to process a request after its last character, and receives one request after the other."""

    async def main() -> None:
        loop = asyncio.get_running_loop()
        settings = SerialSettings(9600, "8N1")
        end = await PtyEnd.open(tmp_path / "line1", LINE, settings)
        port = open_port(tmp_path / "line1")
        line = SerialPacer(settings)
        began_s = loop.time()
        heard = bytearray()
        os.write(port, b"1234567")
        while len(heard) < 15:
            heard += await end.read()
            assert loop.time() - began_s >= line.duration_ns(len(heard)) / 1e9 - 1e-6, "heard before it was there"
            if len(heard) == 7:
                os.write(port, b"89")
                os.write(port, b"abcdef")
        assert heard == b"123456789abcdef"
        os.close(port)
        await end.aclose()

    run(main())


@pytest.mark.parametrize("settings", [SerialSettings(9600, "8N1"), None], ids=["paced", "unpaced"])
@pytest.mark.parametrize("after_s", [0.0, 0.012])
def test_an_answer_begins_so_long_after_the_last_character(
    tmp_path: Path, settings: SerialSettings | None, after_s: float
) -> None:
    """The device's response time counts from the request's end on the line, and is at least the silence of 3.5 characters."""

    async def main() -> None:
        loop = asyncio.get_running_loop()
        end = await PtyEnd.open(tmp_path / "line1", LINE, settings)
        port = open_port(tmp_path / "line1")
        line = SerialPacer(settings or SerialSettings(9600, "8N1"))
        for _ in range(3):
            asked_s = loop.time()
            os.write(port, b"12345678")
            assert await received(end, 8) == b"12345678"
            await end.answer(b"123", after_s)
            least_s = after_s
            if settings is not None:
                least_s = line.duration_ns(11) / 1e9 + max(after_s, line.t3_5_ns / 1e9)
            assert loop.time() - asked_s >= least_s - 1e-6
            assert await take(port, 3) == b"123"
        os.close(port)
        await end.aclose()

    run(main())


def test_a_port_that_closes_while_something_is_on_its_way_forgets_it(tmp_path: Path) -> None:
    async def main() -> None:
        end = await PtyEnd.open(tmp_path / "line1", LINE, SerialSettings(1200, "8N1"))
        port = open_port(tmp_path / "line1")
        os.write(port, bytes(100))
        await eventually(lambda: end._on_its_way is not None)
        await end.aclose()
        assert end._on_its_way is not None
        assert end._on_its_way.cancelled()
        os.close(port)

    run(main())


def test_a_paced_reply_comes_in_pieces_as_it_is_sent(tmp_path: Path) -> None:
    """A client that waits for the first byte must not have to wait for the last one."""

    async def main() -> None:
        end = await PtyEnd.open(tmp_path / "line1", LINE, SerialSettings(1200, "8N1"))
        port = open_port(tmp_path / "line1")
        writing = asyncio.create_task(end.write(bytes(64)))
        first = await take(port, 1)
        assert len(first) <= 32
        assert not writing.done()
        assert len(await take(port, 64 - len(first))) == 64 - len(first)
        await writing
        os.close(port)
        await end.aclose()

    run(main())
