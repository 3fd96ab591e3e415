"""Log everything that a command sends and receives: next to every dump, and in the file of `--log`.

The JSON lines have the format of a run's capture (``t_ns``, ``endpoint``, ``direction``, ``hex``, ``frame``), so
`fieldtwin export` and Wireshark's readers accept both. A line with ``"started"`` precedes each session: user, time and
command line.
"""

from __future__ import annotations

import json
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType
from typing import Self, TextIO

from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.clock import NS_PER_S, Clock
from fieldtwin.gateway.core.connection import Direction, Tap
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.gateway.wallclock import WallClock


class FrameLog(Tap):
    """A log that appends the frames of one session to `path`, line by line.

    Each line has been given to the operating system when the call returns.

    A session writes at most `max_bytes`. After that `full` is True, and nothing more is written. A command that may only
    send logged frames checks `full` before it sends. Raises `FileInvalid` when the file cannot be written.
    """

    def __init__(self, path: Path, words: str, clock: Clock | None = None, max_bytes: int = 1 << 30) -> None:
        self.path = path
        self.full = False
        self.sent = 0
        self._room_bytes = max_bytes
        clock = clock or WallClock()
        try:
            self._file: TextIO = path.open("a", encoding="ascii", buffering=1, newline="\n")
        except OSError as e:
            raise FileInvalid(f"cannot write the log of sent frames: {e.strerror or e}", path=str(path)) from e
        started = datetime.fromtimestamp(clock.utc_ns() / NS_PER_S, UTC).isoformat(timespec="milliseconds")
        self._write({"started": started, "t_ns": clock.monotonic_ns(), "command": words})

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._file.close()

    def on_bytes(self, endpoint: Endpoint, direction: Direction, t_ns: int, data: bytes) -> None:
        self.sent += direction is Direction.SENT
        self._write({"t_ns": t_ns, "endpoint": str(endpoint), "direction": direction.value, "hex": data.hex()})

    def on_frame(self, endpoint: Endpoint, direction: Direction, t_ns: int, frame: CanFrame) -> None:
        self.sent += direction is Direction.SENT
        line = {"t_ns": t_ns, "endpoint": str(endpoint), "direction": direction.value}
        self._write(line | {"hex": frame.data.hex(), "frame": str(frame)})

    def _write(self, line: dict[str, object]) -> None:
        text = json.dumps(line, separators=(",", ":")) + "\n"
        if self.full or len(text) > self._room_bytes:
            self.full = True
            return
        try:
            self._file.write(text)
            self._room_bytes -= len(text)
        except OSError:
            self.full = True
