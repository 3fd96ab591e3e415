"""Messages that were taken out of a mailbox and are not acknowledged yet, kept across the death of the gateway: its successor
acknowledges them, and hands them on no second time.

One JSON file in the run directory: of each transmitter the whole inbox, sequence and payload, as it was when its message was
consumed. A file that cannot be read is as good as none: then a message may come twice. It is written before the acknowledgement,
and in the operating system's hands then: it outlives the process, not a computer that loses its power at that instant.
"""

from __future__ import annotations

import os
from pathlib import Path

import msgspec

from fieldtwin.gateway.core.errors import Unreachable

MOST_BYTES = 1_000_000
"""No file of ours is larger; one that is, is not read."""


class TakenFile:
    """The file at `path`; None keeps nothing beyond this process."""

    def __init__(self, path: Path | None) -> None:
        self._path = path
        self._taken: dict[str, bytes] = {}
        if path is not None:
            try:
                with path.open("rb") as file:
                    entries = msgspec.json.decode(file.read(MOST_BYTES), type=dict[str, str])
                self._taken = {device: bytes.fromhex(raw) for device, raw in entries.items()}
            except (OSError, msgspec.DecodeError, ValueError):
                pass  # none yet, or not one of ours

    def of(self, device: str) -> bytes:
        """The inbox whose message was taken; empty where there is none."""
        return self._taken.get(device, b"")

    def note(self, device: str, raw: bytes) -> None:
        """The message of this inbox was taken; empty: and acknowledged. Raises `Unreachable` when the disk refuses."""
        if raw == self.of(device):
            return
        self._taken.pop(device, None)
        if raw:
            self._taken[device] = raw
        if self._path is None:
            return
        new = self._path.with_suffix(".new")
        try:
            with os.fdopen(os.open(new, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600), "wb") as file:
                file.write(msgspec.json.encode({name: held.hex() for name, held in self._taken.items()}))
            new.replace(self._path)
        except OSError as e:
            raise Unreachable(f"cannot write what was taken: {e.strerror}", where=str(self._path)) from e
