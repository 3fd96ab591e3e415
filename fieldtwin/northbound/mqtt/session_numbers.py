"""The numbers of an MQTT server's sessions, kept in a file, so that a restarted process continues to count them.

Sparkplug's bdSeq must differ between two sessions (3.0.0, 6.4.20); otherwise a host would take the death of the first for the
death of the second.
"""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

LIMIT = 256


class SessionNumbers:
    """Numbers from 0 to 255, and then from 0 again. `path` is the file with the last number."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._last = -1
        with suppress(OSError, ValueError):  # no earlier session
            self._last = int(path.read_text(encoding="ascii"))

    def next(self) -> int:
        """Return the number of the next session."""
        self._last = (self._last + 1) % LIMIT
        with suppress(OSError):  # without a file, the numbers of this process still differ
            self._path.write_text(f"{self._last}\n", encoding="ascii")
        return self._last
