"""Response times, counted in fixed buckets, so that months take no more memory. This module does not know what is measured."""

from __future__ import annotations

from bisect import bisect_left
from collections import deque
from typing import Any

from fieldtwin.gateway.core.clock import NS_PER_MS, NS_PER_S

BOUNDS_MS = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000)
"""Upper limits of the buckets, inclusive; one further bucket counts longer times. They range from TCP on a switch to a
slow serial line with a slow device.
"""

RECENT = 64
"""The number of latest durations that `recent_longest_ns` covers."""

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
        """Return the longest of the last `RECENT` durations, or 0 before the first."""
        return max(self._recent, default=0)

    def describe(self) -> dict[str, Any]:
        """Return a JSON-able description: `bounds_ms`, `counts` (one more than bounds, each for its bucket alone) and
        `total_s`.
        """
        return {"bounds_ms": list(BOUNDS_MS), "counts": list(self.counts), "total_s": self.total_ns / NS_PER_S}
