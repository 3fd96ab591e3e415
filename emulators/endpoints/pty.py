"""A virtual serial port: the emulated device holds the pty's master end, the gateway opens a link to its slave end.

It does not interpret the bytes. It adds properties of a real port that a pty lacks: the port stays when no program has it open (a
spare descriptor of the slave end stays open, because reading would fail with EIO otherwise), bytes pass unchanged (raw mode), and
with `pace` a request and its reply take the time that the line would need. A pty has no parity.
"""

from __future__ import annotations

import asyncio
import errno
import os
from pathlib import Path

from fieldtwin.emulators.wires.serial_line import SerialPacer
from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.connection import ByteConnection, RS232Connection, closed_locally
from fieldtwin.gateway.core.endpoint import Endpoint, SerialSettings
from fieldtwin.gateway.core.errors import ConnectionLost, EndpointBusy, Unreachable
from fieldtwin.gateway.core.files.port_marker import mark_port, remove_dead_port, remove_port

try:
    import termios
except ImportError:  # Windows
    PTYS = False
else:
    PTYS = True

READ_SIZE = 4096
SETTLE_CHECK_S = 0.1
_IDLE_FLAGS = termios.ECHOE | termios.ECHOK | termios.ECHONL if PTYS else 0
"""Flags that only have a meaning in canonical mode, and of which every program that makes a port raw clears at least one.

A pty clears parity, and Debian's tcsetattr (glibc 2.36) then fails with EINVAL if nothing else changed either: a port
that keeps the last program's settings could be opened with 8E1 only once. These flags always change.
"""
FIFO_CHARS = 16
"""A paced reply appears in pieces of this size, as from a UART's FIFO: one timer per character would cost more."""


class PtyEnd(ByteConnection):
    """The device's end of a virtual serial port. Created by `open`.

    `link` is the path for the peer, stable over restarts; `device` is the pty behind it. The peer may close and reopen
    the port any number of times; bytes that it did not read stay until it reads or flushes them.
    """

    def __init__(self, link: Path, endpoint: Endpoint, pace: SerialSettings | None, master: int, spare: int) -> None:
        super().__init__(RS232Connection(), endpoint)
        self.link = link
        self.device = os.ttyname(spare)
        self._master = master
        self._spare = spare
        self._marker = -1
        self._loop = asyncio.get_running_loop()
        self._inward = SerialPacer(pace) if pace else None
        self._outward = SerialPacer(pace) if pace else None
        self._writing = asyncio.Lock()
        self._room: asyncio.Future[None] | None = None
        self._reading = False
        self._settle_check: asyncio.TimerHandle | None = None
        self._on_its_way: asyncio.TimerHandle | None = None

    @property
    def paced(self) -> bool:
        """Return whether bytes take the time of a line."""
        return self._inward is not None

    @classmethod
    async def open(cls, link: Path, endpoint: Endpoint, pace: SerialSettings | None = None) -> PtyEnd:
        """Create the port and its link, replacing an existing link.

        With `pace`, bytes are transferred at the speed of that line: a chunk is readable when its last character has
        arrived. Raises `EndpointBusy` if the path exists and is not a link, `Unreachable` if no port can be created.
        """
        if not PTYS:
            hint = "emulate on tcp, or on a real serial port"
            raise Unreachable("this system has no virtual serial ports", where=str(endpoint), hint=hint)
        try:
            master, spare = os.openpty()
        except OSError as e:
            raise Unreachable(f"cannot create a pty: {e.strerror}", where=str(endpoint)) from e
        try:
            os.set_blocking(master, False)
            _make_raw(spare, pace)
            end = cls(link, endpoint, pace, master, spare)
            end._marker = _replace_link(link, end.device, endpoint)
        except termios.error as e:
            os.close(master)
            os.close(spare)
            raise Unreachable(f"the pty cannot be made raw: {e}", where=str(endpoint)) from e
        except BaseException:
            os.close(master)
            os.close(spare)
            raise
        end._resume_reading()
        end._unsettle()
        return end

    async def write(self, data: bytes) -> None:
        """Send `data` after the data of earlier writers. With pacing, return when the line would have transferred the data."""
        async with self._writing:
            await self._send(data, self._line_is_ours_ns())

    async def answer(self, data: bytes, after_s: float) -> None:
        """Send `data`, `after_s` seconds after the last character received.

        With pacing, at least t3.5 of silence passes first, and all times are computed for the line: a late wake-up of this
        process does not delay the line.
        """
        async with self._writing:
            if self._inward is None:
                await asyncio.sleep(after_s)
                await self._hand_over(data)
                return
            pause_ns = max(round(after_s * NS_PER_S), self._inward.t3_5_ns)
            await self._send(data, self._inward.busy_until_ns + pause_ns)

    async def aclose(self) -> None:
        """Close the port; remove the link unless a different port has replaced it."""
        if self.lost is None:
            self.feed_lost(closed_locally(self.endpoint))
        self._close()

    def on_room(self) -> None:
        if (
            not self._reading
            and self._on_its_way is None
            and self._master >= 0
            and len(self.inbound.data_stream) < self.max_pending
        ):
            self._resume_reading()

    # -- timing of the line ---------------------------------------------------------------------------------------

    async def _send(self, data: bytes, start_ns: int) -> None:
        if self._outward is None:
            await self._hand_over(data)
            return
        for at in range(0, len(data), FIFO_CHARS):
            piece = data[at : at + FIFO_CHARS]
            await self._sleep_until_ns(self._outward.send(start_ns, len(piece)))
            await self._hand_over(piece)

    def _now_ns(self) -> int:
        return round(self._loop.time() * NS_PER_S)

    def _line_is_ours_ns(self) -> int:
        """Return when sending is allowed: t3.5 after the last character from the peer."""
        if self._inward is None:
            return self._now_ns()
        return max(self._now_ns(), self._inward.busy_until_ns + self._inward.t3_5_ns)

    async def _sleep_until_ns(self, deadline_ns: int) -> None:
        await asyncio.sleep(max(0, deadline_ns - self._now_ns()) / NS_PER_S)

    # -- operating system -----------------------------------------------------------------------------------------

    def _resume_reading(self) -> None:
        self._reading = True
        self._loop.add_reader(self._master, self._on_readable)

    def _on_readable(self) -> None:
        # the time is read first, because processing in this program must take no time on the line
        now_ns = self._now_ns()
        try:
            data = os.read(self._master, READ_SIZE)
        except BlockingIOError:
            return
        except OSError as e:
            self._fail(e)
            return
        _raise_idle_flags(self._spare)
        if self._inward is not None:
            self._stop_reading()  # later bytes follow this chunk, and wait in the pty
            end_ns = self._inward.send(now_ns, len(data))
            self._on_its_way = self._loop.call_at(end_ns / NS_PER_S, self._arrived, data)
        elif not self.feed(data):
            self._stop_reading()

    def _arrived(self, data: bytes) -> None:
        self._on_its_way = None
        if self.feed(data):
            self._resume_reading()

    def _stop_reading(self) -> None:
        self._reading = False
        self._loop.remove_reader(self._master)

    def _unsettle(self) -> None:
        """Restore the port's settings for the next program after the last one has changed them."""
        _raise_idle_flags(self._spare)
        self._settle_check = self._loop.call_later(SETTLE_CHECK_S, self._unsettle)

    async def _hand_over(self, data: bytes) -> None:
        while data:
            if self._master < 0:
                raise self.lost or closed_locally(self.endpoint)
            try:
                data = data[os.write(self._master, data) :]
            except BlockingIOError:
                await self._wait_for_room()
            except OSError as e:
                raise self._fail(e) from e

    async def _wait_for_room(self) -> None:
        self._room = self._loop.create_future()
        self._loop.add_writer(self._master, self._on_writable)
        try:
            await self._room
        finally:
            self._room = None
            if self._master >= 0:
                self._loop.remove_writer(self._master)

    def _on_writable(self) -> None:
        if self._room is not None and not self._room.done():
            self._room.set_result(None)

    def _fail(self, error: OSError) -> ConnectionLost:
        what = errno.errorcode.get(error.errno or 0, "?")
        lost = ConnectionLost(f"the virtual serial port broke: {error.strerror} ({what})", where=str(self.endpoint))
        self.feed_lost(lost)
        self._close()
        return lost

    def _close(self) -> None:
        if self._master < 0:
            return
        for timer in (self._settle_check, self._on_its_way):
            if timer is not None:
                timer.cancel()
        self._loop.remove_reader(self._master)
        self._loop.remove_writer(self._master)
        self._on_writable()
        # the link must go before the port is closed, because another program may get its number immediately
        remove_port(self.link, self.device)
        for descriptor in (self._master, self._spare, self._marker):
            os.close(descriptor)
        self._master = self._spare = self._marker = -1
        self._reading = False


def _make_raw(descriptor: int, pace: SerialSettings | None) -> None:
    """Make bytes pass unchanged: no echo, lines, flow control or signals, and no conversion of CR and LF."""
    speed = getattr(termios, f"B{pace.baudrate}", termios.B19200) if pace else termios.B19200
    control = termios.tcgetattr(descriptor)[6]
    control[termios.VMIN], control[termios.VTIME] = 1, 0
    cflag = termios.CS8 | termios.CREAD | termios.CLOCAL
    termios.tcsetattr(descriptor, termios.TCSANOW, [0, 0, cflag, 0, speed, speed, control])


def _raise_idle_flags(descriptor: int) -> None:
    settings = termios.tcgetattr(descriptor)
    if settings[3] & _IDLE_FLAGS != _IDLE_FLAGS:
        settings[3] |= _IDLE_FLAGS
        termios.tcsetattr(descriptor, termios.TCSANOW, settings)


def _replace_link(link: Path, device: str, endpoint: Endpoint) -> int:
    """Create the link and return the descriptor of its marker file. While the descriptor is open, the port counts as live.

    A program that opens the link meanwhile gets either the old port or the new one. The link of a program that was killed is
    removed first, because the new marker would make it look like a live one.
    """
    if os.path.lexists(link) and not link.is_symlink():
        raise EndpointBusy("a file already exists at the path of the virtual serial port", where=f"{endpoint}: {link}")
    beside = link.with_name(f".{link.name}.{os.getpid()}")
    marker = -1
    try:
        remove_dead_port(link)
        marker = mark_port(link, device)
        beside.unlink(missing_ok=True)
        beside.symlink_to(device)
        beside.replace(link)
    except OSError as e:
        if marker >= 0:
            remove_port(link, device)
            os.close(marker)
        raise Unreachable(f"cannot make the link {link}: {e.strerror}", where=str(endpoint)) from e
    return marker
