"""Destinations of a recording in progress: exchanges, CAN frames, or the bytes of a line, in a file that may grow for days.

Each record is one write, so that a recorder that is killed loses at most the last record.
"""

from __future__ import annotations

import json
from datetime import UTC, datetime

from fieldtwin.capture.recordings.rotating_file import RotatingFile
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.clock import NS_PER_S, Clock
from fieldtwin.gateway.core.connection import Direction, Tap
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import FieldtwinError
from fieldtwin.gateway.core.files.candump import line_of
from fieldtwin.gateway.core.files.recording import RecordedExchange, encode_exchange


class ExchangeSink:
    """Writes exchanges to `file`."""

    def __init__(self, file: RotatingFile) -> None:
        self.file = file

    def __call__(self, exchange: RecordedExchange) -> None:
        self.file.line(exchange.t_s, encode_exchange(exchange))


class CanLogSink(Tap):
    """An observer that writes the frames of a bus to `file` in candump format. The difference between UTC and the monotonic clock
    is taken once, at the start.

    An observer of a connection (`Tap`) may not raise: when writing fails, `check` raises the error.
    """

    def __init__(self, file: RotatingFile, clock: Clock, channel: str = "can0") -> None:
        self.file = file
        self._offset_ns = clock.utc_ns() - clock.monotonic_ns()
        self._channel = channel
        self._error: FieldtwinError | None = None

    def on_bytes(self, endpoint: Endpoint, direction: Direction, t_ns: int, data: bytes) -> None:
        """Ignore bytes: a CAN bus transfers only frames."""

    def check(self) -> None:
        """Check that all frames were written. Raises `FileInvalid` otherwise."""
        if self._error is not None:
            raise self._error

    def on_frame(self, endpoint: Endpoint, direction: Direction, t_ns: int, frame: CanFrame) -> None:
        seen_ns = frame.t_ns if direction is Direction.RECEIVED and frame.t_ns else t_ns
        try:
            self.file.line(seen_ns / NS_PER_S, line_of(seen_ns + self._offset_ns, frame, self._channel))
        except FieldtwinError as e:
            self._error = self._error or e


class LineSink:
    """Writes the bytes of a line to `file`, in the form of a capture: monotonic nanoseconds, direction, bytes in hex."""

    def __init__(self, file: RotatingFile, endpoint: Endpoint, clock: Clock, words: str) -> None:
        self.file = file
        self.bytes = {Direction.SENT: 0, Direction.RECEIVED: 0}
        self._endpoint = str(endpoint)
        started = datetime.fromtimestamp(clock.utc_ns() / NS_PER_S, UTC).isoformat(timespec="microseconds")
        now_ns = clock.monotonic_ns()
        self._head: dict[str, object] | None = {"started": started, "t_ns": now_ns, "command": words}

    def saw(self, direction: Direction, t_ns: int, data: bytes) -> None:
        """Write `data` that passed in that direction: SENT is towards the device."""
        # the file is created with the first bytes, so a tap that was never connected leaves no file
        if self._head is not None:
            head, self._head = self._head, None
            self._line(t_ns, head)
        self.bytes[direction] += len(data)
        self._line(t_ns, {"t_ns": t_ns, "endpoint": self._endpoint, "direction": direction.value, "hex": data.hex()})

    def _line(self, t_ns: int, line: dict[str, object]) -> None:
        self.file.line(t_ns / NS_PER_S, json.dumps(line, separators=(",", ":")).encode() + b"\n")
