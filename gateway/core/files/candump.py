"""Read and write CAN logs in the format of candump -L: ``(1436509052.249713) can0 585#4B06200034120000``.

The written logs can be replayed by candump's own tools. Logs may contain CAN FD frames, and error frames of kernels and adapters;
they are counted and omitted. This module must not depend on the meaning of frames.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from fieldtwin.gateway.core.canframe import CanFrame, parse_frame
from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.gateway.core.files.input_file import open_input

_LINE = re.compile(
    rb"\((\d{1,12})\.(\d{1,9})\)\s+(\S{1,64})\s+(([0-9A-Fa-f]{3}|[0-9A-Fa-f]{8})#(?:[Rr][0-8]?|(?:[0-9A-Fa-f]{2}){0,8}))(?:_\d)?(?:\s+[RTrt])?"
)
_FD = re.compile(rb"\(\d{1,12}\.\d{1,9}\)\s+\S{1,64}\s+[0-9A-Fa-f]{3,8}##[0-9A-Fa-f]{1,129}(?:\s+[RT])?")
_ERROR_FLAG = 0x20000000
MAX_LINE = 1024
"""The largest number of bytes of a line, its newline included."""

SUFFIX = ".log"
"""File name suffix by which a log of candump is recognised among recordings."""


@dataclass(slots=True)
class LeftOut:
    """Counts of the frames that `read_lines` omits: CAN FD frames and error frames."""

    fd: int = 0
    errors: int = 0


def line_of(t_ns: int, frame: CanFrame, channel: str = "can0") -> bytes:
    """Return a frame's line, newline included. An error frame is written as candump does: its class with the error flag."""
    seconds, ns = divmod(t_ns, NS_PER_S)
    text = f"{frame.can_id | _ERROR_FLAG:08X}#{frame.data.hex().upper()}" if frame.error else str(frame)
    return f"({seconds}.{ns // 1000:06d}) {channel} {text}\n".encode()


def read_log(path: Path, left: LeftOut | None = None) -> Iterator[tuple[int, str, CanFrame]]:
    """Yield (time stamp in ns, channel, frame) of each line of a file, see `read_lines`. Raises `FileInvalid` also if the file
    cannot be read.
    """
    try:
        with open_input(path) as file:
            yield from read_lines(iter(partial(file.readline, MAX_LINE + 1), b""), str(path), left)
    except OSError as e:
        raise FileInvalid(f"cannot read the log: {e.strerror or e}", path=str(path)) from e


def read_lines(
    lines: Iterable[bytes], path: str = "", left: LeftOut | None = None
) -> Iterator[tuple[int, str, CanFrame]]:
    """Yield (time stamp in ns, channel, frame) of each line. Omitted frames are counted in `left`.

    An invalid line without a newline counts as a truncated last line and ends the log. Raises `FileInvalid` with `path` and the
    line number for any other invalid line, and for a line of more than `MAX_LINE` bytes.
    """
    left = left if left is not None else LeftOut()
    for number, line in enumerate(lines, start=1):
        text = line.strip()
        if not text:
            continue
        found = _LINE.fullmatch(text)
        if found is None:
            if not line.endswith(b"\n") and len(line) <= MAX_LINE:
                return
            if _FD.fullmatch(text):
                left.fd += 1
                continue
            raise FileInvalid(
                "not a line of a CAN log",
                path=path,
                line=number,
                expected="(SECONDS) NAME ID#DATA",
                got=text[:60].decode("ascii", "replace"),
            )
        can_id = int(found[5], 16)
        if can_id & _ERROR_FLAG or can_id > (0x1FFFFFFF if len(found[5]) == 8 else 0x7FF):
            left.errors += 1
            continue
        t_ns = int(found[1]) * NS_PER_S + int(found[2].ljust(9, b"0"))
        yield t_ns, found[3].decode("ascii", "replace"), parse_frame(found[4].decode("ascii"))
