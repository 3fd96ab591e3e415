"""Messages that were taken from a mailbox and are not acknowledged yet, kept in a file in case the gateway process dies.

The next gateway process acknowledges them and does not deliver them a second time. One JSON file in the run directory holds for
each transmitter the whole inbox, sequence and payload, as it was when its message was consumed. A file that cannot be read is
ignored; then a message may be delivered twice. The file is written before the acknowledgement, but only passed to the operating
system: it survives the end of the process, but not a power failure at that moment.
"""

from __future__ import annotations

import os
from pathlib import Path

import msgspec

from fieldtwin.gateway.core.errors import Unreachable

MOST_BYTES = 1_000_000
"""The gateway never writes a larger file, and does not read one."""


class AckedCommandStore:
    """The file of taken messages at `path`. If `path` is None, nothing is kept after this process ends."""

    def __init__(self, path: Path | None) -> None:
        self._path = path
        self._taken: dict[str, bytes] = {}
        if path is not None:
            try:
                with path.open("rb") as file:
                    entries = msgspec.json.decode(file.read(MOST_BYTES), type=dict[str, str])
                self._taken = {device: bytes.fromhex(raw) for device, raw in entries.items()}
            except (OSError, msgspec.DecodeError, ValueError):
                pass  # there is no file yet, or fieldtwin did not write it

    def of(self, device: str) -> bytes:
        """Return the content of the inbox of transmitter `device` whose message was taken, or b"" if none was taken."""
        return self._taken.get(device, b"")

    def note(self, device: str, raw: bytes) -> None:
        """Note that the message of this inbox was taken. An empty `raw` means that it was also acknowledged.

        Raises `Unreachable` if the write fails."""
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
            raise Unreachable(f"cannot store the executed commands: {e.strerror}", where=str(self._path)) from e
