"""The interface through which all code reads the time and waits.

Code that needs the time, or has to wait, receives a `Clock` or is passed ``now``. The implementation for real time is
in gateway/wallclock.py; the one for virtual time belongs to the simulation. No module of fieldtwin.gateway.core imports
``time``.
"""

from __future__ import annotations

from typing import Protocol

NS_PER_S = 1_000_000_000
NS_PER_MS = 1_000_000
NS_PER_US = 1_000


class Clock(Protocol):
    """Monotonic nanoseconds for intervals, UTC nanoseconds for display, and waiting."""

    def monotonic_ns(self) -> int:
        """Return the nanoseconds since an arbitrary start. The value never decreases, and all processes of a host see the same
        time.
        """
        ...

    def utc_ns(self) -> int:
        """Return the nanoseconds since 1970-01-01T00:00:00Z. The value may jump when the host's clock is set."""
        ...

    async def sleep_until_ns(self, deadline_ns: int) -> None:
        """Wait until `monotonic_ns` has reached `deadline_ns`; do not wait if it already has."""
        ...
