"""A candump log that a CANopen node replays, with the replay speed and the policy at its end. `frames` reads the file."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from fieldtwin.emulators.context import EndOfRecording
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.files.candump import read_log


@dataclass(frozen=True, slots=True)
class CanLog:
    """A log file, which is played `speed` times as fast as it was recorded, with the behaviour after its end."""

    path: Path
    speed: float = 1.0
    at_end: EndOfRecording = EndOfRecording.HOLD

    def frames(self) -> Iterator[tuple[int, CanFrame]]:
        """Yield the time in ns and the frame for every classic frame of the log. Raises `FileInvalid`."""
        return ((t_ns, frame) for t_ns, _, frame in read_log(self.path))
