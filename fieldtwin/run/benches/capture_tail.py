"""Read the lines added to a capture file since the last read, as FRAME events of a trace."""

from __future__ import annotations

import json
from pathlib import Path

from fieldtwin.capture.decoding.decoder import frame_events
from fieldtwin.capture.formats.pcap import captured_of
from fieldtwin.gateway.core.errors import FieldtwinError, FileInvalid
from fieldtwin.results.trace import TraceEvent
from fieldtwin.twin.site.system import System

AT_ONCE = 4 << 20


class CaptureTail:
    """A reader that follows a file written by `TapFile` from its current end and reads complete lines only.

    Raises `FileInvalid` for a line that is not a capture line.
    """

    def __init__(self, path: Path, system: System) -> None:
        self._system = system
        self._path = path
        self._rest = b""
        try:
            self._file = path.open("rb")
            self._file.seek(0, 2)
        except OSError as e:
            raise FileInvalid(f"cannot read the capture: {e.strerror or e}", path=str(path)) from e

    def close(self) -> None:
        self._file.close()

    def read(self, start_ns: int) -> list[TraceEvent]:
        """Return the frames that were captured on the system's buses since the last call; times in ns since `start_ns`."""
        *lines, self._rest = (self._rest + self._file.read(AT_ONCE)).split(b"\n")
        try:
            said = [json.loads(line) for line in lines if line]
            captured = [captured_of(line) for line in said if "started" not in line and "refused" not in line]
        except (ValueError, KeyError, TypeError, FieldtwinError) as e:
            raise FileInvalid(f"not a line of a capture: {e}", path=str(self._path)) from e
        return frame_events(captured, self._system, start_ns)
