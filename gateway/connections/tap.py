"""Taps: observers on a `Connector` that see every chunk and frame in both directions, and cannot affect them.

A tap never changes, delays or drops what it sees; a tap that fails is removed and reported, and the connection
continues. Received items are time-stamped when the medium delivers them, whether or not they are read later; sent items
when they have been passed to the medium (a write that fails or is cancelled was not sent).
"""

from __future__ import annotations

import asyncio
import json
from collections import deque
from collections.abc import Coroutine, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TextIO, cast

from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.clock import Clock
from fieldtwin.gateway.core.connection import ByteConnection, CANConnection, CanConnection, Connector, Direction, Tap
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import FieldtwinError, FileInvalid


class TappedConnector(Connector):
    """A connector that opens connections with `inner` and lets `taps` observe them.

    It has to be the outermost wrapper. Then the taps receive the plant's endpoint, even if an inner connector maps it to an
    emulator's.
    """

    def __init__(self, inner: Connector, taps: Sequence[Tap], clock: Clock) -> None:
        self._inner = inner
        self._observers = _Observers(taps, clock)

    @property
    def failed_taps(self) -> int:
        """Return the number of taps that raised and were removed."""
        return self._observers.failed

    async def open_bytes(self, endpoint: Endpoint) -> ByteConnection:
        return _TappedBytes(await self._inner.open_bytes(endpoint), endpoint, self._observers)

    async def open_can(self, endpoint: Endpoint, bitrate: int) -> CanConnection:
        return _TappedCan(await self._inner.open_can(endpoint, bitrate), endpoint, self._observers)


class _Observers:
    """The taps of a connector, and the clock that time-stamps what they receive."""

    def __init__(self, taps: Sequence[Tap], clock: Clock) -> None:
        self._taps = tuple(taps)
        self._now_ns = clock.monotonic_ns
        self.failed = 0

    def saw_bytes(self, endpoint: Endpoint, direction: Direction, chunk: bytes) -> None:
        t_ns = self._now_ns()
        for tap in self._taps:
            try:
                tap.on_bytes(endpoint, direction, t_ns, chunk)
            except Exception as e:  # an observer must not harm the connection
                self._take_off(tap, endpoint, e)

    def saw_frame(self, endpoint: Endpoint, direction: Direction, frame: CanFrame) -> None:
        t_ns = self._now_ns()
        for tap in self._taps:
            try:
                tap.on_frame(endpoint, direction, t_ns, frame)
            except Exception as e:
                self._take_off(tap, endpoint, e)

    def _take_off(self, tap: Tap, endpoint: Endpoint, error: Exception) -> None:
        """Remove the tap and report it. A loop over the taps that is already running still uses the previous tuple."""
        self._taps = tuple(other for other in self._taps if other is not tap)
        self.failed += 1
        asyncio.get_running_loop().call_exception_handler(
            {"message": f"a tap on {endpoint} failed and was removed: {tap!r}", "exception": error}
        )


class _TappedBytes(ByteConnection):
    """A byte connection that reports received and sent chunks to the taps. It shares the inner connection's stream object."""

    def __init__(self, inner: ByteConnection, endpoint: Endpoint, observers: _Observers) -> None:
        super().__init__(inner.inbound, endpoint, inner.max_pending)
        self._inner, self.local = inner, inner.local
        self._observers = observers
        for chunk in inner.inbound.data_stream:  # these chunks arrived while the connection was opened
            observers.saw_bytes(endpoint, Direction.RECEIVED, chunk)
        inner.on_arrival = self._arrived

    @property
    def lost(self) -> FieldtwinError | None:
        return self._inner.lost

    def feed(self, item: bytes) -> bool:
        return self._inner.feed(item)

    def feed_lost(self, error: FieldtwinError) -> None:
        self._inner.feed_lost(error)

    def _arrived(self, chunk: bytes) -> None:
        self._observers.saw_bytes(self.endpoint, Direction.RECEIVED, chunk)
        if self.on_arrival is not None:  # a different tapped connector wraps this one
            self.on_arrival(chunk)

    # Return the inner connection's own coroutine: a coroutine around it would cost time at every wake-up.

    def read(self) -> Coroutine[Any, Any, bytes]:
        return self._inner.read()

    def read_within(self, timeout_s: float) -> Coroutine[Any, Any, bytes]:
        return self._inner.read_within(timeout_s)

    def read_pending(self) -> bytes:
        return self._inner.read_pending()

    async def write(self, data: bytes) -> None:
        await self._inner.write(data)
        self._observers.saw_bytes(self.endpoint, Direction.SENT, data)

    async def aclose(self) -> None:
        await self._inner.aclose()


class _TappedCan(CanConnection):
    """A CAN connection that reports received and sent frames to the taps.

    Frames that an overrun dropped are not reported; the inner connection counts them.
    """

    def __init__(self, inner: CanConnection, endpoint: Endpoint, observers: _Observers) -> None:
        self._inner = inner  # before the base class, which sets `overruns`
        self._observers = observers
        self.bitrate = int(getattr(inner, "bitrate", 0))
        """The bit rate of the medium (bit/s), 0 if it is not known."""
        super().__init__(cast(CANConnection, inner.inbound), endpoint, inner.max_pending)
        self.local = inner.local
        for frame in inner.inbound.data_stream:
            observers.saw_frame(endpoint, Direction.RECEIVED, frame)
        inner.on_arrival = self._arrived

    @property
    def lost(self) -> FieldtwinError | None:
        return self._inner.lost

    @property
    def overruns(self) -> int:
        return self._inner.overruns

    @overruns.setter
    def overruns(self, value: int) -> None:
        # the counter only increases; the base class sets it to 0 first
        self._inner.overruns = max(value, self._inner.overruns)

    def feed(self, item: CanFrame) -> bool:
        return self._inner.feed(item)

    def feed_lost(self, error: FieldtwinError) -> None:
        self._inner.feed_lost(error)

    def _arrived(self, frame: CanFrame) -> None:
        self._observers.saw_frame(self.endpoint, Direction.RECEIVED, frame)
        if self.on_arrival is not None:
            self.on_arrival(frame)

    def recv(self) -> Coroutine[Any, Any, CanFrame]:
        return self._inner.recv()

    async def send(self, frame: CanFrame) -> None:
        await self._inner.send(frame)
        self._observers.saw_frame(self.endpoint, Direction.SENT, frame)

    async def aclose(self) -> None:
        await self._inner.aclose()


@dataclass(frozen=True, slots=True)
class Captured:
    """One chunk or frame, as a tap received it, with its time, endpoint and direction."""

    t_ns: int
    endpoint: Endpoint
    direction: Direction
    item: bytes | CanFrame


class CaptureTap(Tap):
    """A tap that keeps the last `capacity` chunks and frames in memory. `dropped` counts the older items that were removed."""

    def __init__(self, capacity: int = 10_000) -> None:
        self._seen: deque[Captured] = deque(maxlen=capacity)
        self.dropped = 0

    @property
    def captured(self) -> list[Captured]:
        """Return the kept items, oldest first."""
        return list(self._seen)

    def stream(self, endpoint: Endpoint, direction: Direction) -> bytes:
        """Return all kept bytes of one direction of one endpoint, joined in order."""
        kept = (c.item for c in self._seen if c.endpoint == endpoint and c.direction is direction)
        return b"".join(item for item in kept if isinstance(item, bytes))

    def on_bytes(self, endpoint: Endpoint, direction: Direction, t_ns: int, data: bytes) -> None:
        self._keep(Captured(t_ns, endpoint, direction, bytes(data)))

    def on_frame(self, endpoint: Endpoint, direction: Direction, t_ns: int, frame: CanFrame) -> None:
        self._keep(Captured(t_ns, endpoint, direction, frame))

    def _keep(self, captured: Captured) -> None:
        if len(self._seen) == self._seen.maxlen:
            self.dropped += 1
        self._seen.append(captured)


class TapFile(Tap):
    """A tap that writes JSON lines: ``{"t_ns", "endpoint", "direction", "hex"}``; a frame adds ``"frame"`` in candump's notation.

    A line has been passed to the operating system when the call returns, so after a crash at most the last line is
    incomplete. At most `max_bytes` are written. `dropped` counts items that were not written, and `error` gives the
    reason if the disk caused it: a capture that ends early never ends the run.
    """

    def __init__(self, path: Path, max_bytes: int = 1 << 30, *, head: Mapping[str, object] | None = None) -> None:
        """Create the file, replacing an existing file. `head`, if given, becomes the first line and describes the run; it has a
        key ``started``.

        Raises `FileInvalid` if the file cannot be created.
        """
        self.path = path
        self.dropped = 0
        self.error: OSError | None = None
        self._room_bytes = max_bytes
        try:
            self._file: TextIO | None = path.open("w", encoding="ascii", buffering=1, newline="\n")
        except OSError as e:
            raise FileInvalid(f"cannot write the capture: {e.strerror or e}", path=str(path)) from e
        if head is not None:
            self._write(dict(head))

    def on_bytes(self, endpoint: Endpoint, direction: Direction, t_ns: int, data: bytes) -> None:
        self._write({"t_ns": t_ns, "endpoint": str(endpoint), "direction": direction.value, "hex": data.hex()})

    def on_frame(self, endpoint: Endpoint, direction: Direction, t_ns: int, frame: CanFrame) -> None:
        line: dict[str, Any] = {"t_ns": t_ns, "endpoint": str(endpoint), "direction": direction.value}
        line |= {"hex": frame.data.hex(), "frame": str(frame)}
        if frame.error:
            line["error"] = True  # candump's notation does not distinguish an error frame from a data frame
        self._write(line)

    def on_refusal(self, refusal: Mapping[str, object]) -> None:
        """Append a line for a write that was refused before it reached its device. `refusal` holds the time as ``t_ns``.

        A refused write is part of the run's history, although no bytes were sent.
        """
        self._write({"t_ns": refusal["t_ns"], "refused": dict(refusal)})

    def close(self) -> None:
        """Finish the file. Closing twice does nothing; items that arrive later are counted as dropped."""
        file, self._file = self._file, None
        if file is not None:
            try:
                file.close()
            except OSError as e:
                self.error = self.error or e

    def _write(self, line: dict[str, Any]) -> None:
        text = json.dumps(line, separators=(",", ":")) + "\n"
        if self._file is None or len(text) > self._room_bytes:
            self.dropped += 1
            return
        try:
            self._file.write(text)
            self._room_bytes -= len(text)
        except OSError as e:
            self.error = e
            self.dropped += 1
            self.close()
