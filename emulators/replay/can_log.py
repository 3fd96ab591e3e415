"""A CAN log as candump -L writes it: ``(1436509052.249713) can0 585#4B06200034120000``. It returns frames with times.

`CanLog` is such a file as a node's recording: its path and how it is played. It is read when frames are requested.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from fieldtwin.emulators.context import EndOfRecording
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.gateway.core.files.input_file import open_input

_LINE = re.compile(
    r"\((\d+\.\d+)\)\s+\S+\s+([0-9A-F]{3}|[0-9A-F]{8})#(R[0-8]?|(?:[0-9A-F]{2}){0,8})(?:\s+[RT])?", re.IGNORECASE
)
_ERROR = 0x20000000
MAX_LINE_BYTES = 1024
"""A line of candump has at most 60 characters, plus the name of its interface."""

SUFFIX = ".log"
"""File name suffix by which a log of candump is recognised among recordings."""


@dataclass(frozen=True, slots=True)
class CanLog:
    """A log file, played `speed` times as fast as it was recorded, and the behaviour after its end."""

    path: Path
    speed: float = 1.0
    at_end: EndOfRecording = EndOfRecording.HOLD

    def frames(self) -> Iterator[tuple[float, CanFrame]]:
        """Yield the frames of the file (`read_can_log`). Raises `FileInvalid`, also if the file cannot be read."""
        try:
            with open_input(self.path) as file:
                yield from read_can_log(_lines(file, str(self.path)), str(self.path))
        except OSError as e:
            raise FileInvalid("the log cannot be read", path=str(self.path), got=e.strerror or str(e)) from e


def _lines(file: BinaryIO, path: str) -> Iterator[str]:
    number = 0
    while line := file.readline(MAX_LINE_BYTES + 1):
        number += 1
        if len(line) > MAX_LINE_BYTES:
            raise FileInvalid(
                "the line is too long", path=path, line=number, expected=f"at most {MAX_LINE_BYTES} bytes"
            )
        yield line.decode("ascii", "replace")


def read_can_log(lines: Iterable[str], path: str = "") -> Iterator[tuple[float, CanFrame]]:
    """Yield the time in the log in seconds, and the frame; error frames are left out.

    Raises `FileInvalid` with the line.
    """
    for number, line in enumerate(lines, start=1):
        if not line.strip():
            continue
        found = _LINE.fullmatch(line.strip())
        if found is None:
            raise FileInvalid(
                "not a line of a CAN log",
                path=path,
                line=number,
                expected="(SECONDS) NAME ID#DATA",
                got=line.strip()[:60],
            )
        identifier, body = int(found[2], 16), found[3]
        if identifier & _ERROR:
            continue
        if body[:1] in "Rr" and body:
            frame = CanFrame(identifier, extended=len(found[2]) > 3, remote=True, dlc=int(body[1:] or "0"))
        else:
            frame = CanFrame(identifier, bytes.fromhex(body), extended=len(found[2]) > 3)
        yield float(found[1]), frame
