"""Monotonic times of the process image as times in UTC."""

from __future__ import annotations

from fieldtwin.gateway.core.clock import NS_PER_MS, Clock

CLOCK_STEP_NS = 10 * NS_PER_MS
"""If UTC differs by more than this from the expected time, the host's clock was set, and later times follow it."""


class UtcTimes:
    """Converts monotonic times. The offset stays constant, so that equal times remain equal, until the clock is set."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._offset_ns = clock.utc_ns() - clock.monotonic_ns()

    def follow(self) -> None:
        """Take over a new offset if the host's clock was set."""
        offset_ns = self._clock.utc_ns() - self._clock.monotonic_ns()
        if abs(offset_ns - self._offset_ns) > CLOCK_STEP_NS:
            self._offset_ns = offset_ns

    def ns(self, monotonic_ns: int) -> int:
        """Return a monotonic time in nanoseconds since 1970-01-01 UTC."""
        return monotonic_ns + self._offset_ns

    def ms(self, monotonic_ns: int) -> int:
        """Return a monotonic time in milliseconds since 1970-01-01 UTC."""
        return self.ns(monotonic_ns) // NS_PER_MS
