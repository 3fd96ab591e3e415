"""Relay the bytes between a Modbus client and its devices unchanged, and record them with time and direction.

`near` is the endpoint to which the client connects: a serial port, a pseudo-terminal that this module creates, or a TCP port
on which it listens. `far` is the endpoint of the device. The bytes are not interpreted while they are recorded.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from pathlib import Path
from typing import Any

from fieldtwin.capture.recordings.sinks import LineSink
from fieldtwin.emulators.endpoints.socket_end import SocketEnd, SocketListener
from fieldtwin.gateway.connections.os_connector import OsConnector
from fieldtwin.gateway.core.clock import Clock
from fieldtwin.gateway.core.connection import ByteConnection, Connector, Direction
from fieldtwin.gateway.core.endpoint import SERIAL_SCHEMES, Endpoint
from fieldtwin.gateway.core.errors import ConnectionLost, FieldtwinError, Unreachable, UsageError
from fieldtwin.gateway.wallclock import WallClock

OnMessage = Callable[[str], None]


class LineTap:
    """A relay between `near` and `far` that records the bytes in `sink`. `on_message` is called with messages for the user.

    A TCP client that disconnects is not an error. If the device cannot be reached, the TCP client is disconnected; this is not an
    error either, and the next client may connect.
    """

    def __init__(
        self, near: Endpoint, far: Endpoint, sink: LineSink, *, on_message: OnMessage = lambda text: None,
        connector: Connector | None = None, clock: Clock | None = None,
    ) -> None:  # fmt: skip
        if near.is_can or far.is_can or far.scheme == "pty":
            raise UsageError("only a byte stream can be tapped", expected="serial ports or TCP", got=f"{near}, {far}")
        self._near, self._far, self._sink, self._on_message = near, far, sink, on_message
        self._connector = connector or OsConnector()
        self._clock = clock or WallClock()
        self._failed: asyncio.Future[None] | None = None

    async def run(self, stop: asyncio.Event) -> None:
        """Relay until `stop` is set.

        Raises `Unreachable` if an endpoint cannot be opened, `ConnectionLost` when a serial line is lost, `FileInvalid` when
        writing fails.
        """
        self._failed = asyncio.get_running_loop().create_future()
        stopping: asyncio.Future[Any] = asyncio.ensure_future(stop.wait())
        closing: list[SocketListener | ByteConnection] = []
        running: list[asyncio.Future[Any]] = [self._failed]
        try:
            if self._near.scheme in ("tcp", "rtu+tcp"):
                listener = await SocketListener.open(self._near, self._serve, 1)
                closing.append(listener)
                self._on_message(f"{listener.bound}  ⇄  {self._far}")
            else:
                far = await self._connector.open_bytes(self._far)
                closing.append(far)
                near = await self._open_near()
                closing.append(near)
                running.append(asyncio.ensure_future(self._carry(near, far)))
                self._on_message(f"{self._near.path}  ⇄  {self._far}")
            await asyncio.wait([stopping, *running], return_when=asyncio.FIRST_COMPLETED)
            for done in running:
                if done.done():
                    done.result()
        finally:
            for task in (stopping, *running):
                task.cancel()
            await asyncio.gather(stopping, *running, return_exceptions=True)
            for end in reversed(closing):
                await end.aclose()

    async def _open_near(self) -> ByteConnection:
        path = Path(self._near.path)
        if self._near.scheme in SERIAL_SCHEMES and path.is_char_device():
            return await self._connector.open_bytes(self._near)
        from fieldtwin.emulators.endpoints.pty import PtyEnd  # imported late: not every system has pseudo-terminals

        serial = Endpoint("rtu", path=self._near.path, params=self._near.params)
        return await PtyEnd.open(path, serial)

    async def _serve(self, client: SocketEnd) -> None:
        """Connect one TCP client to the device, and relay its bytes until either side closes the connection."""
        try:
            far = await self._connector.open_bytes(self._far)
        except Unreachable as e:
            self._on_message(f"{client.peer} was rejected: {e}")
            return
        self._on_message(f"{client.peer} came")
        try:
            await self._carry(client, far)
        except ConnectionLost as e:
            self._on_message(f"{client.peer} is gone: {e}")
        except FieldtwinError as e:
            if self._failed is not None and not self._failed.done():
                self._failed.set_exception(e)
        finally:
            await far.aclose()

    async def _carry(self, near: ByteConnection, far: ByteConnection) -> None:
        """Relay bytes in both directions until one of the connections is lost."""
        ways = [
            asyncio.ensure_future(self._one_way(near, far, Direction.SENT)),
            asyncio.ensure_future(self._one_way(far, near, Direction.RECEIVED)),
        ]
        try:
            await asyncio.wait(ways, return_when=asyncio.FIRST_EXCEPTION)
            for way in ways:
                if way.done():
                    way.result()
        finally:
            for way in ways:
                way.cancel()
            await asyncio.gather(*ways, return_exceptions=True)

    async def _one_way(self, source: ByteConnection, target: ByteConnection, direction: Direction) -> None:
        while True:
            data = await source.read()
            self._sink.saw(direction, self._clock.monotonic_ns(), data)
            await target.write(data)
