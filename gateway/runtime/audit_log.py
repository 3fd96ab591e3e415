"""The audit log: every write, NMT command and refusal, as one JSON line each, appended and never rewritten.

An entry holds the source (the PLC, the safe-state logic, the start-up configuration), the action, the old and the new value, and
the result. The values of a secret tag are not recorded. If the log cannot be written, nothing is written to the plant: no action
is taken without a record.
"""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any, BinaryIO

from fieldtwin.gateway.core.clock import Clock
from fieldtwin.gateway.core.errors import Unreachable


class AuditLog:
    """An audit log at `path`, which only its owner may read. Each entry is written to the file before `note` returns."""

    def __init__(self, path: Path, clock: Clock) -> None:
        self._clock = clock
        self._path = path
        self.entries = 0
        try:
            descriptor = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o600)
        except OSError as e:
            raise Unreachable(f"cannot open the audit log: {e.strerror}", where=str(path)) from e
        self._file: BinaryIO = os.fdopen(descriptor, "ab", buffering=0)

    def note(self, action: str, device: str, *, by: str, result: str, **details: Any) -> None:
        """Write one entry. `action` is write, nmt, sdo or refuse. `result` is asked (about to be sent), done, refused or failed,
        with a reason. `by` names the source. Raises `Unreachable` if the entry cannot be written.
        """
        entry = {
            "utc_ns": self._clock.utc_ns(),
            "action": action,
            "device": device,
            "by": by,
            "result": result,
            **details,
        }
        try:
            self._file.write(json.dumps(entry, separators=(",", ":"), default=str).encode() + b"\n")
        except OSError as e:
            raise Unreachable(f"cannot write the audit log: {e.strerror}", where=str(self._path)) from e
        self.entries += 1

    def close(self) -> None:
        self._file.close()
