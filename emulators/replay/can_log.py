"""A log of candump as a node's recording: its path and how it is played. It is read when frames are requested."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from fieldtwin.emulators.context import EndOfRecording
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.files.candump import read_log


@dataclass(frozen=True, slots=True)
class CanLog:
    """A log file, played `speed` times as fast as it was recorded, and the behaviour after its end."""

    path: Path
    speed: float = 1.0
    at_end: EndOfRecording = EndOfRecording.HOLD

    def frames(self) -> Iterator[tuple[int, CanFrame]]:
        """Yield time in the log in ns, and frame, of all classic frames. Raises `FileInvalid`."""
        return ((t_ns, frame) for t_ns, _, frame in read_log(self.path))
