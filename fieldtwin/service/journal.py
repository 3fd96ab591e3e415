"""Write a service's events as lines of text, lines of JSON, or journal entries with fields (systemd.journal-fields(7)).

The journal's native protocol is a datagram of ``NAME=value`` lines to its socket; a value that contains a line feed is written
as its length and its bytes (https://systemd.io/JOURNAL_NATIVE_PROTOCOL/).
"""

from __future__ import annotations

import json
import re
import socket
import sys
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from typing import Literal, TextIO

from fieldtwin.service.events import ServiceEvent

JOURNAL = "/run/systemd/journal/socket"
Format = Literal["text", "json", "journal"]

_FIELD = re.compile(r"[^A-Z0-9_]")


class EventLog:
    """The event log. If the journal is missing, an event becomes a line of JSON on stderr, and `lost` counts it."""

    def __init__(
        self,
        format: Format,
        system: str,
        utc_ns: Callable[[], int],
        out: TextIO | None = None,
        journal: str = JOURNAL,
    ) -> None:
        self._format = format
        self._system = system
        self._utc_ns = utc_ns
        self._out = out if out is not None else sys.stderr
        self._journal = journal
        self._socket: socket.socket | None = None
        self.lost = 0
        if format == "journal":
            self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)
            self._socket.setblocking(False)

    def write(self, event: ServiceEvent) -> None:
        """Write one event. Never waits."""
        if self._format == "text":
            print(event.message, file=self._out, flush=True)
        elif self._socket is None or not self._to_journal(event):
            print(self._json(event), file=self._out, flush=True)

    def close(self) -> None:
        """Close the socket."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _json(self, event: ServiceEvent) -> str:
        at = datetime.fromtimestamp(self._utc_ns() / 1e9, UTC).isoformat(timespec="milliseconds")
        named = {"t": at, "priority": int(event.priority), "event": event.name, "system": self._system}
        return json.dumps({**named, "message": event.message, **event.fields}, ensure_ascii=False)

    def _to_journal(self, event: ServiceEvent) -> bool:
        assert self._socket is not None
        named = {
            "MESSAGE": event.message,
            "PRIORITY": str(int(event.priority)),
            "SYSLOG_IDENTIFIER": "fieldtwin",
            "FIELDTWIN_SYSTEM": self._system,
            "FIELDTWIN_EVENT": event.name,
            **{f"FIELDTWIN_{_FIELD.sub('_', name.upper())}": str(value) for name, value in event.fields.items()},
        }
        try:
            self._socket.sendto(datagram(named), self._journal)
        except OSError:
            self.lost += 1
            return False
        return True


def datagram(fields: Mapping[str, str]) -> bytes:
    """Return one entry of the journal's native protocol."""
    parts = []
    for name, value in fields.items():
        data = value.encode(errors="replace")
        if b"\n" in data:
            parts.append(name.encode() + b"\n" + len(data).to_bytes(8, "little") + data + b"\n")
        else:
            parts.append(name.encode() + b"=" + data + b"\n")
    return b"".join(parts)
