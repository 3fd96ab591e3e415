"""Read and write CAN logs in the format of candump -L: ``(1436509052.249713) can0 585#4B06200034120000``.

The written logs can be replayed by candump's own tools. Logs may contain additions of kernels and adapters: CAN FD
frames and error frames are counted and omitted. This module must not depend on the meaning of frames.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.gateway.core.files.input_file import open_input

_LINE = re.compile(
    rb"\((\d{1,12})\.(\d{6,9})\)\s+(\S{1,64})\s+([0-9A-Fa-f]{3}|[0-9A-Fa-f]{8})#(R[0-8]?|(?:[0-9A-Fa-f]{2}){0,8})(?:_\d)?(?:\s+[RT])?"
)
_FD = re.compile(rb"\(\d{1,12}\.\d{6,9}\)\s+\S{1,64}\s+[0-9A-Fa-f]{3,8}##[0-9A-Fa-f]{1,129}(?:\s+[RT])?")
_ERROR_FLAG = 0x20000000
MAX_LINE = 1024


@dataclass(slots=True)
class LeftOut:
    """The content of a log apart from classic data and remote frames."""

    fd: int = 0
    errors: int = 0


def line_of(t_ns: int, frame: CanFrame, channel: str = "can0") -> bytes:
    """Return a frame's line, newline included. An error frame is written as candump does: its class with the error flag."""
    seconds, ns = divmod(t_ns, NS_PER_S)
    if frame.error:
        text = f"{frame.can_id | _ERROR_FLAG:08X}#{frame.data.hex().upper()}"
    elif frame.remote:
        text = f"{frame.can_id:0{8 if frame.extended else 3}X}#R{frame.dlc or ''}"
    else:
        text = f"{frame.can_id:0{8 if frame.extended else 3}X}#{frame.data.hex().upper()}"
    return f"({seconds}.{ns // 1000:06d}) {channel} {text}\n".encode()


def read_log(path: Path, left: LeftOut | None = None) -> Iterator[tuple[int, str, CanFrame]]:
    """Yield (ns, channel, frame) of each line. A truncated last line is omitted. Raises `FileInvalid` with the line."""
    left = left if left is not None else LeftOut()
    number = 0
    try:
        with open_input(path) as file:
            while line := file.readline(MAX_LINE + 1):
                number += 1
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
                    got = text[:60].decode("ascii", "replace")
                    raise FileInvalid(
                        "not a line of a CAN log",
                        path=str(path),
                        line=number,
                        expected="(SECONDS) NAME ID#DATA",
                        got=got,
                    )
                t_ns = int(found[1]) * NS_PER_S + int(found[2].ljust(9, b"0"))
                frame = _frame(found[4], found[5])
                if frame is None:
                    left.errors += 1
                else:
                    yield t_ns, found[3].decode("ascii", "replace"), frame
    except OSError as e:
        raise FileInvalid(f"cannot read the log: {e.strerror or e}", path=str(path)) from e


def _frame(identifier: bytes, body: bytes) -> CanFrame | None:
    """Return the frame; None for an error frame, and for an invalid identifier."""
    can_id, extended = int(identifier, 16), len(identifier) == 8
    if can_id & _ERROR_FLAG or can_id > (0x1FFFFFFF if extended else 0x7FF):
        return None
    if body[:1] in (b"R", b"r"):
        return CanFrame(can_id, extended=extended, remote=True, dlc=int(body[1:] or b"0"))
    return CanFrame(can_id, bytes.fromhex(body.decode("ascii")), extended=extended)
