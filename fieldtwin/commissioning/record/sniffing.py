"""Listen with one adapter to a serial line between other devices. Requests and replies arrive in one stream, and nothing is
sent.

`Directions` distinguishes them by their shape and order, so that the capture has a direction for each frame. Limit: a client
that repeats a write (function 05 or 06) after no reply sends a frame that looks like the reply.
"""

from __future__ import annotations

import asyncio

from fieldtwin.capture.decoding.modbus_frames import ModbusFrame, splitter
from fieldtwin.capture.recordings.sinks import LineSink
from fieldtwin.commissioning.record.tapping import OnMessage
from fieldtwin.commissioning.scan.traffic import SETTLE_NS, is_reply
from fieldtwin.gateway.connections.os_connector import OsConnector
from fieldtwin.gateway.core.clock import NS_PER_S, Clock
from fieldtwin.gateway.core.connection import Connector, Direction
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.gateway.protocols.modbus.frames.selection import framing_of
from fieldtwin.gateway.wallclock import WallClock


class Directions:
    """A splitter of one stream into frames that finds each frame's direction: SENT is towards a device.

    `framing` is rtu or ascii. The class does no I/O.
    """

    def __init__(self, framing: str) -> None:
        self._splitter = splitter(framing)
        self._asked: ModbusFrame | None = None
        self._last_ns: int | None = None

    def feed(self, data: bytes, t_ns: int) -> list[tuple[Direction, ModbusFrame]]:
        """Add bytes received at `t_ns`; return the frames that are now complete, oldest first, including damaged ones."""
        found = self.settle(t_ns)
        self._last_ns = t_ns
        return found + [self._told(frame) for frame in self._splitter.feed(data, t_ns)]

    def settle(self, now_ns: int) -> list[tuple[Direction, ModbusFrame]]:
        """Return the frames that have ended because the line was silent until `now_ns`; an incomplete frame is returned as
        damaged.
        """
        if self._last_ns is None or now_ns - self._last_ns <= SETTLE_NS:
            return []
        return self.flush()

    def flush(self) -> list[tuple[Direction, ModbusFrame]]:
        """Return the remaining bytes as frames, at the end of the stream."""
        return [self._told(frame) for frame in self._splitter.flush()]

    def _told(self, frame: ModbusFrame) -> tuple[Direction, ModbusFrame]:
        if frame.bad:
            return (Direction.SENT if self._asked is None else Direction.RECEIVED), frame
        asked = self._asked
        if is_reply(frame, asked):
            self._asked = None
            return Direction.RECEIVED, frame
        self._asked = frame if frame.unit else None  # a broadcast has no reply
        return Direction.SENT, frame


class LineSniffer:
    """A passive listener at the serial port `port` that passes every frame with its direction to `sink`."""

    def __init__(
        self, port: Endpoint, sink: LineSink, *, on_message: OnMessage = lambda text: None,
        connector: Connector | None = None, clock: Clock | None = None,
    ) -> None:  # fmt: skip
        framing = framing_of(port)
        if not port.is_serial or framing not in ("rtu", "ascii"):
            raise UsageError("--sniff needs a serial line", expected="such as rtu:/dev/ttyUSB0", got=str(port))
        self._port, self._sink, self._on_message = port, sink, on_message
        self._directions = Directions(framing)
        self._connector, self._clock = connector or OsConnector(), clock or WallClock()

    async def run(self, stop: asyncio.Event) -> None:
        """Listen until `stop` is set.

        Raises `Unreachable` if the port cannot be opened, `ConnectionLost` when it is lost.
        """
        connection = await self._connector.open_bytes(self._port)
        self._on_message(f"listening at {self._port}; nothing is sent")
        try:
            while not stop.is_set():
                data = await connection.read_within(SETTLE_NS / NS_PER_S)
                now_ns = self._clock.monotonic_ns()
                self._keep(self._directions.feed(data, now_ns) if data else self._directions.settle(now_ns))
        finally:
            self._keep(self._directions.flush())
            await connection.aclose()

    def _keep(self, frames: list[tuple[Direction, ModbusFrame]]) -> None:
        for direction, frame in frames:
            self._sink.saw(direction, frame.t_ns, frame.raw)
