"""The evidence of a verdict about a client: the frames and events of its case as lines, and the command that repeats it."""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from fieldtwin.conformance.core.observation import (
    Ended,
    Event,
    Garbled,
    Left,
    ObservedConnection,
    ReplySent,
    RequestSeen,
    Sent,
    ValuePublished,
)
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.clock import NS_PER_MS
from fieldtwin.gateway.protocols.canopen import cob_id
from fieldtwin.gateway.protocols.canopen.sdo.abort_codes import meaning

MOST_LINES = 200
"""Largest number of lines of evidence for a case: its first and its last ones are kept."""
ABORT = 0x80


@dataclass(frozen=True, slots=True)
class Line:
    """One event.

    `t_ms` counts from the first request that received a wrong reply. `by` is ``client``, ``device``, ``probe`` or
    ``program``; `data` is a frame in hex (a CAN frame in candump format), and `text` describes it.
    """

    t_ms: float
    by: str
    data: str
    text: str

    def as_json(self) -> dict[str, Any]:
        return {"t_ms": self.t_ms, "by": self.by, "data": self.data, "text": self.text}

    def __str__(self) -> str:
        return f"{self.t_ms:10.1f} ms  {self.by:<7}  {' '.join(filter(None, (self.data, self.text)))}"


def lines(events: Iterable[Event], begun_ns: int) -> tuple[Line, ...]:
    """Return all events of a case, the oldest first; beyond `MOST_LINES` one line replaces those in the middle.

    The times of the lines count from `begun_ns`.
    """
    found = [Line(round((e.t_ns - begun_ns) / NS_PER_MS, 3), *line_of(e)) for e in events]
    if len(found) <= MOST_LINES:
        return tuple(found)
    head, tail = found[: MOST_LINES // 2], found[-MOST_LINES // 2 :]
    left_out = len(found) - len(head) - len(tail)
    return (*head, Line(head[-1].t_ms, "", "", f"{left_out} more events are left out here"), *tail)


def line_of(event: Event) -> tuple[str, str, str]:
    """Return the sender, the frame, and a description in words."""
    match event:
        case RequestSeen():
            return "client", event.frame or event.target.hex(" "), _request(event)
        case ReplySent():
            text = _abort(event.data) if "#" in event.frame else ""
            return (
                "device",
                event.frame or event.data.hex(" "),
                text or ("honest" if event.good else "as the test case requires"),
            )
        case Sent():
            frame = CanFrame(int.from_bytes(event.data[:2], "big"), event.data[2:])
            sdo = cob_id.SDO_REQUEST_BASE < frame.can_id < cob_id.SDO_REQUEST_BASE + 0x80
            return "client", str(frame), _abort(frame.data) if sdo else ""
        case Garbled():
            return "client", event.data.hex(" "), "no request"
        case ObservedConnection():
            return (
                ("device", "", "gives the port back")
                if event.by_us
                else ("client", "", f"opens connection {event.client}")
            )
        case Left():
            return ("device" if event.by_us else "client"), "", f"closes connection {event.client}"
        case ValuePublished():
            return "probe", "", f"published {event.text or 'no value'} ({event.word.value})"
        case Ended():
            return "program", "", f"ended, exit code {event.status}"


def _request(asked: RequestSeen) -> str:
    return f"transaction {asked.tag}" if asked.tag else ""


def _abort(data: bytes) -> str:
    """Return an SDO abort in words; "" for any other frame. Some clients send the multiplexer 0 for the open transfer."""
    if len(data) != 8 or data[0] != ABORT:
        return ""
    code = int.from_bytes(data[4:8], "little")
    index, subindex = int.from_bytes(data[1:3], "little"), data[3]
    of = f"{index:04X}h:{subindex:02X}" if index else "multiplexer 0: the open transfer"
    return f"SDO abort {code:08X}h {meaning(code)} ({of})"


def reproduce(argv: Sequence[str], id: str) -> str:
    """Return the command line `argv` (without the program's name) for the case `id` alone.

    The checker's options stand before ``--``; the program under test and its own options follow it.
    """
    at = list(argv).index("--") if "--" in argv else len(argv)
    ours, theirs = list(argv[:at]), list(argv[at:])
    kept: list[str] = []
    while ours:
        word = ours.pop(0)
        if word == "--only":
            del ours[:1]
        elif not word.startswith("--only="):
            kept.append(word)
    return shlex.join(["fieldtwin", *kept[:2], "--only", id, *kept[2:], *theirs])
