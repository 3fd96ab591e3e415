"""A serial port as a `ByteConnection`, on systems whose ports have descriptors (`threads` is for other systems).

`port` finds, locks and configures the port. Reading and writing are non-blocking operations of the event loop on the descriptor,
so a port needs no thread and a chunk is delivered as soon as the driver has it.

This module must not depend on a protocol: no frames, gaps or unit IDs. A frame that arrives in five pieces, because a USB
adapter delivers data every 16 ms, is five chunks here.
"""

from __future__ import annotations

import asyncio
import os
from contextlib import suppress
from typing import cast

from fieldtwin.gateway.connections.serial.line_counters import UartCounters, read_control_lines, read_counters
from fieldtwin.gateway.connections.serial.port import CHUNK, Port, close_unwanted, lost, open_port
from fieldtwin.gateway.core.connection import ByteConnection, RS232Connection, closed_locally
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import FieldtwinError

with suppress(ImportError):  # Windows: `threads` is used there
    import termios

DRAIN_LIMIT_S = 1.0
"""The time in seconds that closing waits for the last bytes to be sent; a whole shutdown has 2 s."""


class SerialConnection(ByteConnection):
    """One end of a serial line (in the paper, an RS232 connection).

    This object holds at most `max_pending` unread chunks of `CHUNK` bytes. Then the port is not read until half of them have been
    taken; meanwhile the operating system's buffer, and then the flow control of the line if it has one, holds the rest.

    If the port is unplugged, or the other side of a pty is gone, the bytes that arrived are still read; then `read` and `write`
    raise `ConnectionLost`. The descriptor is closed immediately, so that the port gets its old name back when it is plugged in
    again.
    """

    def __init__(self, port: Port, endpoint: Endpoint, max_pending: int = 1024) -> None:
        """Take over an open, non-blocking `port`. Create a connection with `open` instead."""
        super().__init__(RS232Connection(), endpoint, max_pending)
        self._port = port
        self._fd = int(port.fileno())
        self._loop = asyncio.get_running_loop()
        self._turn = asyncio.Lock()
        self._room: asyncio.Future[None] | None = None
        self._reading = False
        self.ignored = _ignored_settings(self._fd, endpoint)
        """Settings that the port's driver accepted silently but does not apply, such as ``parity E`` on a pty."""
        self._resume()

    @classmethod
    async def open(cls, endpoint: Endpoint, max_pending: int = 1024) -> SerialConnection:
        """Lock and configure the port; bytes that were received before are discarded.

        Raises `Unreachable` if the port does not exist or permission is missing, `EndpointBusy` if another program uses
        it, `UsageError` if the port does not support the baud rate or frame, or has no RS485 mode although it is
        requested.
        """
        # In a thread: opening a USB adapter exchanges messages with it, and a faulty one takes seconds to answer.
        opening = asyncio.get_running_loop().run_in_executor(None, open_port, endpoint)
        try:
            port = await asyncio.shield(opening)
        except asyncio.CancelledError:
            opening.add_done_callback(close_unwanted)
            raise
        return cls(port, endpoint, max_pending)

    async def write(self, data: bytes) -> None:
        """Pass `data` to the driver, waiting while its buffer is full. Concurrent writes are not mixed.

        The bytes are not sent yet when this returns: the last character is sent up to ``len(data)`` character times
        later (`SerialSettings.char_time_s`), and later still with a USB adapter. Raises `ConnectionLost`.
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
        """Wait until written bytes have been sent (at most `DRAIN_LIMIT_S`), then close. Closing twice does nothing."""
        if self._lost is None:
            await self._drain()
            self._fail(closed_locally(self.endpoint))
        self.inbound.data_stream.clear()

    def counters(self) -> UartCounters | None:
        """Return the driver's counters, including errors, or None if it has none."""
        return read_counters(self._fd) if self._lost is None else None

    def control_lines(self) -> dict[str, bool]:
        """Return CTS, DSR, DCD, RI, DTR and RTS as they are now; empty if the port has none."""
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
        """End the connection; only the first reason is kept."""
        if self._lost is None:
            self.feed_lost(error)
            self._reading = False
            self._loop.remove_reader(self._fd)
            self._loop.remove_writer(self._fd)
            self._port.close()
            self._on_writable()  # wakes a writer that waits

    async def _drain(self) -> None:
        """Wait until the driver's buffer is empty. Discard unsendable bytes, because close(2) would wait 30 s for them."""
        deadline_s = self._loop.time() + DRAIN_LIMIT_S
        try:
            while self._lost is None and self._port.out_waiting:
                if self._loop.time() >= deadline_s:
                    self._port.reset_output_buffer()
                    return
                await asyncio.sleep(0.005)
        except (OSError, termios.error):
            return  # the port was lost while it was closed: there are no bytes left to wait for


def _ignored_settings(fd: int, endpoint: Endpoint) -> tuple[str, ...]:
    """Return the settings that the driver ignored. A pty clears parity silently and keeps all other settings."""
    asked = endpoint.serial
    try:
        cflag = cast(int, termios.tcgetattr(fd)[2])
    except termios.error:
        return ()  # already unplugged; the first read reports it
    ignored = []
    kept_parity = "N" if not cflag & termios.PARENB else "O" if cflag & termios.PARODD else "E"
    if kept_parity != asked.parity:
        ignored.append(f"parity {asked.parity}")
    if cflag & termios.CSIZE != (termios.CS8 if asked.data_bits == 8 else termios.CS7):
        ignored.append(f"{asked.data_bits} data bits")
    if bool(cflag & termios.CSTOPB) != (asked.stop_bits == 2):
        ignored.append(f"{asked.stop_bits} stop bits")
    return tuple(ignored)
