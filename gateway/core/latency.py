"""How long answers took: counts in fixed buckets, bounded over months. It never knows what is measured."""

from __future__ import annotations

from bisect import bisect_left
from collections import deque
from typing import Any

from fieldtwin.gateway.core.clock import NS_PER_MS, NS_PER_S

BOUNDS_MS = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000)
"""Upper ends of the buckets, inclusive; what took longer is in one more. From TCP on a switch to a slow line with a slow unit."""

RECENT = 64
"""How many durations `recent_longest_ns` looks back."""

_BOUNDS_NS = tuple(ms * NS_PER_MS for ms in BOUNDS_MS)


class Latencies:
    """Counts durations in nanoseconds; a negative one counts as 0."""

    def __init__(self) -> None:
        self.counts = [0] * (len(BOUNDS_MS) + 1)
        self.total_ns = 0
        self._recent: deque[int] = deque(maxlen=RECENT)

    def note(self, duration_ns: int) -> None:
        """Count one duration."""
        duration_ns = max(0, duration_ns)
        self.counts[bisect_left(_BOUNDS_NS, duration_ns)] += 1
        self.total_ns += duration_ns
        self._recent.append(duration_ns)

    @property
    def recent_longest_ns(self) -> int:
        """The longest of the last `RECENT` durations; 0 before the first."""
        return max(self._recent, default=0)

    def describe(self) -> dict[str, Any]:
        """JSON-able: `bounds_ms`, `counts` (one more than bounds, each of its bucket alone) and `total_s`."""
        return {"bounds_ms": list(BOUNDS_MS), "counts": list(self.counts), "total_s": self.total_ns / NS_PER_S}
