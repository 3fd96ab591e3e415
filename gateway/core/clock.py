"""Time enters by this door.

Everything that needs to know what time it is, or to wait, is given a `Clock` or is passed ``now``. The wall
implementation is in gateway/wallclock.py; a virtual one belongs to the prototype. No module of fieldtwin.gateway.core imports
``time``.
"""

from __future__ import annotations

from typing import Protocol

NS_PER_S = 1_000_000_000
NS_PER_MS = 1_000_000


class Clock(Protocol):
    """Monotonic nanoseconds for intervals, UTC nanoseconds for people, and waiting."""

    def monotonic_ns(self) -> int:
        """Nanoseconds since an arbitrary start; never goes back. On one host the same for every process."""
        ...

    def utc_ns(self) -> int:
        """Nanoseconds since 1970-01-01T00:00:00Z; may jump when the host's clock is set."""
        ...

    async def sleep_until_ns(self, deadline_ns: int) -> None:
        """Return at or after `deadline_ns` of `monotonic_ns`; at once when that has passed."""
        ...
