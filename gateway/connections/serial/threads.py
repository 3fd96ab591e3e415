"""A serial port as a `ByteConnection` on systems whose ports have no descriptors for an event loop: Windows' COM ports.

One thread reads and another writes; both wait in pyserial. Bytes are delivered later than in `line` by the time that it
takes to wake a thread. Otherwise both modules behave the same. This module must not depend on a protocol.
"""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from fieldtwin.gateway.connections.serial.line_counters import UartCounters
from fieldtwin.gateway.connections.serial.port import CHUNK, Port, close_unwanted, lost, open_port
from fieldtwin.gateway.core.connection import ByteConnection, RS232Connection, closed_locally
from fieldtwin.gateway.core.endpoint import Endpoint

POLL_S = 0.05
"""The time that the reading thread waits in the driver; closing takes up to this long."""
WRITE_S = 5.0
"""A port that accepts no bytes for this long is considered lost: flow control that blocks forever, or an adapter that hangs."""


class ThreadedSerialConnection(ByteConnection):
    """One end of a serial line, with the same limits and errors as `SerialConnection`."""

    def __init__(self, port: Port, endpoint: Endpoint, max_pending: int = 1024) -> None:
        """Take over an open `port`. Create a connection with `open` instead."""
        super().__init__(RS232Connection(), endpoint, max_pending)
        self._port = port
        self._loop = asyncio.get_running_loop()
        self._turn = asyncio.Lock()
        self._stopping = threading.Event()
        self._room = threading.Event()
        self._room.set()
        self._writer = ThreadPoolExecutor(1, "serial-write")
        self._reader = threading.Thread(target=self._read_port, name=f"reads {endpoint}", daemon=True)
        self._reader.start()

    @classmethod
    async def open(cls, endpoint: Endpoint, max_pending: int = 1024) -> ThreadedSerialConnection:
        """Open a port as `SerialConnection.open` does."""
        opening = asyncio.get_running_loop().run_in_executor(None, open_port, endpoint, POLL_S, WRITE_S)
        try:
            port = await asyncio.shield(opening)
        except asyncio.CancelledError:
            opening.add_done_callback(close_unwanted)
            raise
        return cls(port, endpoint, max_pending)

    async def write(self, data: bytes) -> None:
        """Pass `data` to the driver. Bytes of concurrent writes are not mixed. Raises `ConnectionLost`."""
        async with self._turn:
            if self._lost is not None:
                raise self._loss()
            try:
                await self._loop.run_in_executor(self._writer, self._port.write, data)
            except (
                OSError,
                ValueError,
                TypeError,
            ) as e:  # pyserial's own errors are OSErrors; a port that was closed meanwhile raises other errors
                self.feed_lost(lost(self.endpoint, str(e)))
                raise self._loss() from e

    async def aclose(self) -> None:
        """Wait until written bytes have been sent, then close. Closing twice does nothing."""
        self.feed_lost(closed_locally(self.endpoint))
        if not self._stopping.is_set():
            self._stopping.set()
            self._room.set()
            await self._loop.run_in_executor(None, self._close)
        self.inbound.data_stream.clear()

    def on_room(self) -> None:
        if len(self.inbound.data_stream) <= self.max_pending // 2:
            self._room.set()

    def counters(self) -> UartCounters | None:
        """Return None: these systems have no counters."""
        return None

    def control_lines(self) -> dict[str, bool]:
        """Return CTS, DSR, DCD, RI, DTR and RTS as they are now; empty if the port has none."""
        try:
            port = self._port
            lines = {"CTS": port.cts, "DSR": port.dsr, "DCD": port.cd, "RI": port.ri, "DTR": port.dtr, "RTS": port.rts}
        except (OSError, ValueError):
            return {}
        return {name: bool(on) for name, on in lines.items()}

    def _close(self) -> None:
        self._reader.join()
        self._writer.shutdown()
        self._port.close()

    # -- the reading thread ----------------------------------------------------------------------------------------

    def _read_port(self) -> None:
        while not self._stopping.is_set():
            try:
                data = self._port.read(1)
                data += self._port.read(min(self._port.in_waiting, CHUNK)) if data else b""
            except (OSError, ValueError, TypeError) as e:
                self._tell(self.feed_lost, lost(self.endpoint, str(e)))
                return
            if data:
                self._room.clear()
                self._tell(self._take, bytes(data))
                while not self._room.wait(POLL_S) and not self._stopping.is_set():
                    pass

    def _take(self, data: bytes) -> None:
        if self._lost is None and self.feed(data):
            self._room.set()

    def _tell(self, what: Callable[[Any], object], item: object) -> None:
        try:
            self._loop.call_soon_threadsafe(what, item)
        except RuntimeError:
            self._stopping.set()  # the loop is closed: stop reading
