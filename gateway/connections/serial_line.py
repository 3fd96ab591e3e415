"""A serial port as a `ByteConnection`, where ports have descriptors (`serial_threads` is for other systems).

`serial_port` finds, locks and configures the port; reading and writing are plain non-blocking descriptor work of the event
loop, so no thread stands behind a port and a chunk is delivered when the driver has it.

It must never know a protocol: no frame, no gap, no unit id. A frame that arrives in five pieces, because a USB adapter
hands over every 16 ms, is five chunks here.
"""

from __future__ import annotations

import asyncio
import os
from contextlib import suppress
from typing import cast

from fieldtwin.gateway.connections.line_counters import LineCounters, read_control_lines, read_counters
from fieldtwin.gateway.connections.serial_port import CHUNK, Port, close_unwanted, lost, open_port
from fieldtwin.gateway.core.connection import ByteConnection, RS232Connection, closed_here
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import FieldtwinError

with suppress(ImportError):  # Windows: `serial_threads` is used there
    import termios

DRAIN_LIMIT_S = 1.0
"""How long closing waits for the last bytes to leave; a shutdown as a whole has 2 s."""


class SerialConnection(ByteConnection):
    """One end of a serial line (SPEC: an RS232 connection).

    Bounded: at most `max_pending` chunks of `CHUNK` bytes wait here; then the port is not read until half of them are
    gone, and the operating system's buffer, and then the line's flow control if it has one, takes the rest.

    Unplugged, or a pty whose other side is gone: what arrived is still read, then `read` and `write` raise
    `ConnectionLost`. The descriptor is closed at once, so that the port gets its old name back when it returns.
    """

    def __init__(self, port: Port, endpoint: Endpoint, max_pending: int = 1024) -> None:
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
        opening = asyncio.get_running_loop().run_in_executor(None, open_port, endpoint)
        try:
            port = await asyncio.shield(opening)
        except asyncio.CancelledError:
            opening.add_done_callback(close_unwanted)
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
                    self._fail(lost(self.endpoint, e.strerror or str(e)))
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
            self._fail(lost(self.endpoint, e.strerror or str(e)))
            return
        if not data:
            self._fail(lost(self.endpoint, "hung up"))
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
