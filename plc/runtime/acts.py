"""The record of what users do to a PLC (force, unforce, pause, go, step, restart): one JSON line each in the audit log.

The file and the format are those of the gateway's audit log, appended line by line: the user, the action, the old and the new
value. An action that cannot be recorded is not carried out. This module does not interpret actions.
"""

from __future__ import annotations

import json
import os
from typing import Any

from fieldtwin.gateway.core.errors import Unreachable


class Acts:
    """The record in the file at `path`, which is created if necessary and which only its owner may read.

    If `path` is ``""``, nothing is written."""

    def __init__(self, path: str) -> None:
        self.counts: dict[str, int] = {}
        """How often each action was carried out since the process began."""
        self._path = path
        self._descriptor = -1
        if path:
            try:
                self._descriptor = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC, 0o600)
            except OSError as e:
                raise self._failed("open", e) from e

    def note(self, action: str, by: str, utc_ns: int, **details: Any) -> None:
        """Write one entry. Raises `Unreachable` if it cannot be written; the action must not be carried out then."""
        if self._descriptor >= 0:
            self._write(action, by, utc_ns, details)
        self.counts[action] = self.counts.get(action, 0) + 1

    def _write(self, action: str, by: str, utc_ns: int, details: dict[str, Any]) -> None:
        entry = {
            "utc_ns": utc_ns,
            "action": action,
            "device": "plc",
            "by": by or "unknown",
            "result": "asked",
            **details,
        }
        try:  # in one write, because the gateway appends to the same file
            os.write(self._descriptor, json.dumps(entry, separators=(",", ":"), default=str).encode() + b"\n")
        except OSError as e:
            raise self._failed("write", e) from e

    def close(self) -> None:
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1

    def _failed(self, what: str, e: OSError) -> Unreachable:
        return Unreachable(f"cannot {what} the audit log: {e.strerror or e}", where=self._path)
