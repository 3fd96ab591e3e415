"""How often each fault struck, also after it was taken away: a fault that never struck has tested nothing."""

from __future__ import annotations

from collections import deque
from typing import Any

from fieldtwin.emulators.faults.fault import Active

MOST = 10_000
"""Faults that are remembered; the oldest are forgotten."""


class FaultHistory:
    """Every fault that was put in, the first one first."""

    def __init__(self) -> None:
        self._put_in: deque[tuple[int, Active, str]] = deque(maxlen=MOST)
        self.count = 0
        """How many were put in."""

    def add(self, active: Active, on: str) -> None:
        """Remember a fault that is put in on a device or bus."""
        self.count += 1
        self._put_in.append((self.count, active, on))

    def describe(self) -> list[dict[str, Any]]:
        """Return, for each fault, its number (from 1), id, name, what it is on, how often it struck, and whether it need not."""
        return [
            {
                "number": number,
                "id": active.id,
                "name": active.fault.name,
                "on": on,
                "struck": active.struck,
                "optional": active.aim.optional,
            }
            for number, active, on in self._put_in
        ]
