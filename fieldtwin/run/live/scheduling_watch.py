"""Detect that this process was stopped or got no processor time; meanwhile missing answers of other processes prove nothing."""

from __future__ import annotations

from collections.abc import Callable

from fieldtwin.gateway.core.clock import NS_PER_S, Clock

STILL_S = 3.0
"""If more time than this (seconds) lies between two checks, this process was itself stopped or got no processor time."""


class SchedulingWatch:
    """The times at which this process checks the others.

    `note` is called with the text of each gap. For `answers_s` seconds and `STILL_S` after a gap, missing answers prove nothing.
    """

    def __init__(self, clock: Clock, answers_s: float, note: Callable[[str], None]) -> None:
        self._clock = clock
        self._answers_s = answers_s
        self._note = note
        self._looked_ns = 0
        """The time of the last check; 0 before the first."""
        self._still_ns = -(1 << 62)
        """The time when the last gap was noticed."""

    def look(self) -> int:
        """Begin a check of the other processes, and return its time (monotonic)."""
        self.was_suspended()
        self._looked_ns = self._clock.monotonic_ns()
        return self._looked_ns

    def was_suspended(self) -> bool:
        """Return whether this process was not scheduled recently."""
        gap_s = (self._clock.monotonic_ns() - self._looked_ns) / NS_PER_S
        if self._looked_ns and gap_s > STILL_S:
            self._still_ns = self._clock.monotonic_ns()
            self._note(f"run: this process was not scheduled for {gap_s:.1f} s")
        return self._clock.monotonic_ns() - self._still_ns < (STILL_S + self._answers_s) * NS_PER_S
