"""The changes after a frame: those of the tags that it carried, and those of the tags that PLC programs write.

A change that followed a frame was not necessarily caused by it; for this reason the page says "after".
"""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

from fieldtwin.studio.live.frame_log import FrameLog
from fieldtwin.studio.live.tag_history import Point
from fieldtwin.twin.site.system import System

WITHIN_NS = 500_000_000
MOST_CHANGES = 200


class Effect(NamedTuple):
    """A change of a tag. `program` is the program that writes the tag, "" for a value that the frame carried."""

    t_ns: int
    tag: str
    before: Any
    value: Any
    quality: str
    reason: str
    program: str


class Changes(Protocol):
    """The history of tags, of a running instance or of a trace."""

    def changes(self, name: str, from_ns: int, to_ns: int) -> list[tuple[Point | None, Point]]:
        """Return the changes of a tag in an interval, each with the point before it."""


def effects_of(system: System, history: Changes, frames: FrameLog, number: int) -> list[Effect]:
    """Return the changes from a frame's request until `WITHIN_NS` after the frame, at most `MOST_CHANGES`, oldest first."""
    row = frames.row(number)
    from_ns = row.t_ns if row.request is None else frames.row(row.request).t_ns
    reply = frames.reply_to(number)
    carried = {f"{row.device}.{name}": "" for name in row.tags}
    if reply is not None:
        carried |= {f"{row.device}.{name}": "" for name in frames.row(reply).tags}
    written = {tag: program for program, form in system.plc.programs.items() for tag in form.outputs.values()}
    found = []
    for tag, program in (written | carried).items():
        for before, point in history.changes(tag, from_ns, row.t_ns + WITHIN_NS):
            old = before.value if before is not None else None
            if before is not None and (old, before.quality, before.reason) == point[1:]:
                continue  # read again with the same value
            found.append(Effect(point.t_ns, tag, old, point.value, point.quality, point.reason, program))
    return sorted(found, key=lambda effect: effect.t_ns)[:MOST_CHANGES]
