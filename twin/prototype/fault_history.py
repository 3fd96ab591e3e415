"""The number of times that each fault took effect. Cleared faults are included, because a fault that never took effect has
tested nothing.
"""

from __future__ import annotations

from collections import deque

from fieldtwin.emulators.faults.fault import Active
from fieldtwin.twin.prototype.field_status import StruckStatus

MOST = 10_000
"""Number of faults that are remembered; the oldest are forgotten."""


class FaultHistory:
    """Every fault that was injected, in the order of injection."""

    def __init__(self) -> None:
        self._put_in: deque[tuple[int, Active, str]] = deque(maxlen=MOST)
        self.count = 0
        """Number of faults that were injected."""

    def add(self, active: Active, on: str) -> None:
        """Add a fault that was injected into the device or bus `on`."""
        self.count += 1
        self._put_in.append((self.count, active, on))

    def struck(self) -> list[StruckStatus]:
        """Return how often each injected fault took effect, in the order of injection."""
        return [
            StruckStatus(
                number=number,
                id=active.id,
                name=active.fault.name,
                on=on,
                struck=active.struck,
                optional=active.aim.optional,
            )
            for number, active, on in self._put_in
        ]
