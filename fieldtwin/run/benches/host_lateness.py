"""The lateness of a test that runs on the same host as the system. Times are in seconds since the scenario's start.

There are two measures, which must not be mixed. *Own* lateness is the time by which a sleep of the testing process ended too
late: the host gave it no processor time, and the system under test is not the cause. *Any* lateness also includes slow answers
and scans of the PLC that began late: the cause may be the host, or a gateway that is stuck.
"""

from __future__ import annotations

from collections import deque

KEPT = 10_000
SLACK_S = 0.005
"""Tolerance in seconds: a sleep that overshoots by less is normal and is not counted."""


class HostLateness:
    """The measured delays of the host, of which the latest `KEPT` are kept."""

    def __init__(self) -> None:
        self._own: deque[tuple[float, float]] = deque(maxlen=KEPT)
        self._any: deque[tuple[float, float]] = deque(maxlen=KEPT)

    def slept(self, t_s: float, late_s: float) -> None:
        """Record that a sleep of the testing process ended at `t_s`, `late_s` seconds later than requested."""
        if late_s > SLACK_S:
            self._own.append((t_s, late_s - SLACK_S))

    def waited(self, t_s: float, late_s: float) -> None:
        """Record a delay of `late_s` seconds that the host or the system may have caused, and that was seen at `t_s`: a check
        that ended late, or a scan of the PLC that began late.
        """
        if late_s > SLACK_S:
            self._any.append((t_s, late_s))

    def longest_s(self, since_s: float) -> float:
        """Return the longest single delay of any kind that ended after `since_s`."""
        return max((late_s for t_s, late_s in self._any if t_s >= since_s), default=0.0)

    def own_s(self, since_s: float) -> float:
        """Return the total own lateness after `since_s`. Sleeps do not overlap; the part before `since_s` is not counted."""
        return sum(min(late_s, t_s - since_s) for t_s, late_s in self._own if t_s > since_s)

    def any_s(self, since_s: float) -> float:
        """Return the total lateness of any kind after `since_s`."""
        return sum(min(late_s, t_s - since_s) for t_s, late_s in self._any if t_s > since_s)
