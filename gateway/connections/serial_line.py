"""A serial port as a `ByteConnection`: the one file on the gateway's side that imports ``serial``.

pyserial finds, locks and configures the port (it knows the baud rates and quirks of each system); reading and writing
are plain non-blocking descriptor work of the event loop, so no thread stands behind a port and a chunk is delivered
when the driver has it.

It must never know a protocol: no frame, no gap, no unit id. A frame that arrives in five pieces, because a USB adapter
hands over every 16 ms, is five chunks here.
"""

from __future__ import annotations

import asyncio
import errno
import grp
import os
import stat
import termios
from typing import cast

import serial
from serial.tools import list_ports

from gateway.connections.line_counters import LineCounters, read_control_lines, read_counters
from gateway.connections.rs485 import let_driver_switch
from gateway.core.connection import ByteConnection, RS232Connection, closed_here
from gateway.core.endpoint import Endpoint
from gateway.core.errors import ConnectionLost, EndpointBusy, FieldtwinError, Unreachable, UsageError

CHUNK = 4096
"""Most bytes taken in one read: the size of the kernel's own buffer of a tty."""

DRAIN_LIMIT_S = 1.0
"""How long closing waits for the last bytes to leave; a shutdown as a whole has 2 s."""

_BUSY = (errno.EAGAIN, errno.EBUSY, errno.EWOULDBLOCK)
_ABSENT = (errno.ENOENT, errno.ENXIO, errno.ENODEV)


class SerialConnection(ByteConnection):
    """One end of a serial line (SPEC: an RS232 connection).

    Bounded: at most `max_pending` chunks of `CHUNK` bytes wait here; then the port is not read until half of them are
    gone, and the operating system's buffer, and then the line's flow control if it has one, takes the rest.

    Unplugged, or a pty whose other side is gone: what arrived is still read, then `read` and `write` raise
    `ConnectionLost`. The descriptor is closed at once, so that the port gets its old name back when it returns.
    """

    def __init__(self, port: serial.Serial, endpoint: Endpoint, max_pending: int = 1024) -> None:
        """Take over an open, non-blocking `port`; use `open`."""
        super().__init__(RS232Connection(), endpoint, max_pending)
        self._port = port
        self._fd = int(port.fileno())
        self._loop = asyncio.get_running_loop()
        self._turn = asyncio.Lock()
        self._room: asyncio.Future[None] | None = None
        self._reading = False
        self.ignored = _ignored_settings(self._fd, endpoint)
        """Settings that the port's driver took without a word and does not apply, such as ``parity E`` on a pty."""
        self._resume()

    @classmethod
    async def open(cls, endpoint: Endpoint, max_pending: int = 1024) -> SerialConnection:
        """Lock and configure the port; what the line said before is thrown away.

        Raises `Unreachable` when there is no such port or no permission, `EndpointBusy` when another program holds it,
        `UsageError` when the port cannot do the baud rate or frame, or has no RS485 mode and is asked for it.
        """
        # In a thread: opening a USB adapter is a conversation with it, and a sick one takes seconds to answer.
        opening = asyncio.get_running_loop().run_in_executor(None, _open_port, endpoint)
        try:
            port = await asyncio.shield(opening)
        except asyncio.CancelledError:
            opening.add_done_callback(_close_unwanted)
            raise
        return cls(port, endpoint, max_pending)

    async def write(self, data: bytes) -> None:
        """Hand `data` to the driver, waiting while its buffer is full; writers take turns, so no two are mixed.

        Handed over is not sent: the last character leaves up to ``len(data)`` character times later
        (`SerialSettings.char_time_s`), longer behind a USB adapter. Raises `ConnectionLost`.
        """
        async with self._turn:
            rest = memoryview(data)
            while rest:
                if self._lost is not None:
                    raise self._loss()
                try:
                    rest = rest[os.write(self._fd, rest) :]
                except (BlockingIOError, InterruptedError):
                    await self._wait_for_room()
                except OSError as e:
                    self._fail(_lost(self.endpoint, e.strerror or str(e)))
                    raise self._loss() from e

    async def aclose(self) -> None:
        """Let what was written leave (at most `DRAIN_LIMIT_S`), then close. Closing twice does nothing."""
        if self._lost is None:
            await self._drain()
            self._fail(closed_here(self.endpoint))
        self.inbound.data_stream.clear()

    def counters(self) -> LineCounters | None:
        """What the driver counted, errors among it; None where it counts nothing."""
        return read_counters(self._fd) if self._lost is None else None

    def control_lines(self) -> dict[str, bool]:
        """CTS, DSR, DCD, RI, DTR and RTS as they are now; empty where the port has none."""
        return read_control_lines(self._fd) if self._lost is None else {}

    def on_room(self) -> None:
        if not self._reading and self._lost is None and len(self.inbound.data_stream) <= self.max_pending // 2:
            self._resume()

    def _resume(self) -> None:
        self._reading = True
        self._loop.add_reader(self._fd, self._on_readable)

    def _on_readable(self) -> None:
        try:
            data = os.read(self._fd, CHUNK)
        except (BlockingIOError, InterruptedError):
            return
        except OSError as e:  # EIO: the adapter was pulled, or the other side of a pty closed
            self._fail(_lost(self.endpoint, e.strerror or str(e)))
            return
        if not data:
            self._fail(_lost(self.endpoint, "hung up"))
        elif not self.feed(data):
            self._reading = False
            self._loop.remove_reader(self._fd)

    async def _wait_for_room(self) -> None:
        self._room = self._loop.create_future()
        self._loop.add_writer(self._fd, self._on_writable)
        try:
            await self._room
        finally:
            self._room = None
            if self._lost is None:
                self._loop.remove_writer(self._fd)

    def _on_writable(self) -> None:
        if self._room is not None and not self._room.done():
            self._room.set_result(None)

    def _fail(self, error: FieldtwinError) -> None:
        """End the connection; only the first reason counts."""
        if self._lost is None:
            self.feed_lost(error)
            self._reading = False
            self._loop.remove_reader(self._fd)
            self._loop.remove_writer(self._fd)
            self._port.close()
            self._on_writable()  # a writer that waits learns of it

    async def _drain(self) -> None:
        """Wait until the driver's buffer is empty; throw away what does not leave, or close(2) waits 30 s for it."""
        deadline_s = self._loop.time() + DRAIN_LIMIT_S
        try:
            while self._lost is None and self._port.out_waiting:
                if self._loop.time() >= deadline_s:
                    self._port.reset_output_buffer()
                    return
                await asyncio.sleep(0.005)
        except (OSError, termios.error):
            return  # gone while it was closing: there is nothing left to wait for


def _open_port(endpoint: Endpoint) -> serial.Serial:
    settings = endpoint.serial
    try:
        port = serial.Serial(
            port=endpoint.path,
            baudrate=settings.baudrate,
            bytesize=settings.data_bits,
            parity=settings.parity,
            stopbits=settings.stop_bits,
            timeout=0,
            write_timeout=0,
            # 0 and not None gives VMIN 1: an empty port then reads EAGAIN, and b"" can only mean that it hung up
            inter_byte_timeout=0.0,
            exclusive=True,
        )
        if endpoint.rs485:
            _set_rs485(port, endpoint)
        return port
    except serial.SerialException as e:
        raise _cannot_open(endpoint, e.errno or 0, str(e)) from e
    except (ValueError, termios.error) as e:
        raise UsageError(
            "the port refuses these settings",
            got=f"{settings.baudrate} baud, {settings.frame}",
            where=str(endpoint),
            hint=str(e),
        ) from e
    except OSError as e:
        raise _cannot_open(endpoint, e.errno or 0, str(e)) from e


def _set_rs485(port: serial.Serial, endpoint: Endpoint) -> None:
    try:
        let_driver_switch(int(port.fileno()))
    except OSError as e:
        port.close()
        raise UsageError(
            "the port has no RS485 mode",
            expected="a driver that switches the direction (ioctl TIOCSRS485)",
            got=e.strerror or str(e),
            where=str(endpoint),
            hint="leave rs485=1 out where the adapter switches by itself",
        ) from e


def _close_unwanted(opening: asyncio.Future[serial.Serial]) -> None:
    """Whoever asked for the port went away before it was open."""
    if not opening.cancelled() and opening.exception() is None:
        opening.result().close()


def _cannot_open(endpoint: Endpoint, number: int, text: str) -> Unreachable:
    where = str(endpoint)
    if number in _BUSY:
        return EndpointBusy("the port is held by another program", where=where, hint=f"fuser {endpoint.path} names it")
    if number in _ABSENT:
        return Unreachable("there is no such serial port", where=where, hint=_ports_hint())
    if number in (errno.EACCES, errno.EPERM):
        return Unreachable("no permission for the port", where=where, hint=_group_hint(endpoint.path))
    if number == errno.ENOTTY or "Could not configure port" in text:  # pyserial gives this one no number
        return Unreachable("this is no serial port", where=where, hint=_ports_hint())
    return Unreachable(f"cannot open the port: {os.strerror(number) if number else text}", where=where)


def _lost(endpoint: Endpoint, why: str) -> ConnectionLost:
    return ConnectionLost(f"the serial port is gone: {why}", where=str(endpoint))


def ports_here() -> list[str]:
    """The serial ports that this computer has now, by name."""
    return sorted(port.device for port in list_ports.comports())


def _ports_hint() -> str:
    names = ports_here()
    return f"ports here: {', '.join(names[:8])}" if names else "this computer has no serial port now"


def _group_hint(path: str) -> str:
    """Which group may use the port: dialout on Debian, uucp elsewhere; the file itself knows."""
    try:
        info = os.stat(path)
        group = grp.getgrgid(info.st_gid).gr_name
    except (OSError, KeyError):
        return ""
    if not info.st_mode & stat.S_IWGRP or group == "root":
        return f"only its owner may use {path}"
    return f"join its group and log in again: sudo usermod -aG {group} $USER"


def _ignored_settings(fd: int, endpoint: Endpoint) -> tuple[str, ...]:
    """Compare what the driver kept with what was asked for. A pty clears parity silently and keeps the rest."""
    asked = endpoint.serial
    try:
        cflag = cast(int, termios.tcgetattr(fd)[2])
    except termios.error:
        return ()  # unplugged already; the first read says so
    ignored = []
    kept_parity = "N" if not cflag & termios.PARENB else "O" if cflag & termios.PARODD else "E"
    if kept_parity != asked.parity:
        ignored.append(f"parity {asked.parity}")
    if cflag & termios.CSIZE != (termios.CS8 if asked.data_bits == 8 else termios.CS7):
        ignored.append(f"{asked.data_bits} data bits")
    if bool(cflag & termios.CSTOPB) != (asked.stop_bits == 2):
        ignored.append(f"{asked.stop_bits} stop bits")
    return tuple(ignored)
