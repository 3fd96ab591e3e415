"""Log the frames of a client under test and its hostile device.

The JSON lines are like those of `fieldtwin.commissioning.access.frame_log`. The directions are those of the client: "sent"
means sent by the client.
"""

from __future__ import annotations

from pathlib import Path

from fieldtwin.commissioning.access.frame_log import FrameLog
from fieldtwin.conformance.core.evidence import line_of
from fieldtwin.conformance.core.observation import Event, Garbled, ReplySent, RequestSeen, Sent


class ClientLog(FrameLog):
    """A log that appends to `path`. `where` is the endpoint on which the client is served, `words` the command line."""

    def __init__(self, path: Path, where: str, words: str) -> None:
        super().__init__(path, words)
        self._where = where

    def on_event(self, event: Event) -> None:
        """Write a line for a frame; connections, published values and the program's end are not written."""
        if not isinstance(event, RequestSeen | ReplySent | Sent | Garbled):
            return
        _, frame, _ = line_of(event)
        head, _, data = frame.rpartition("#")
        line: dict[str, object] = {"t_ns": event.t_ns, "endpoint": self._where}
        line |= {
            "direction": "received" if isinstance(event, ReplySent) else "sent",
            "hex": data.replace(" ", "").lower(),
        }
        self._write(line | ({"frame": frame} if head else {}))
