"""A histogram of durations, whose memory does not grow with their number. It does not depend on what is measured."""

from __future__ import annotations

from bisect import bisect_left
from collections import deque
from collections.abc import Sequence
from typing import Any

from fieldtwin.gateway.core.clock import NS_PER_MS

RESPONSE_MS = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000)
"""The limits of `response_times` in ms: from TCP on a switch to a slow serial line with a slow device."""

_PER_DOUBLING = 32
_FINE_NS = (
    *range(2 * _PER_DOUBLING),
    *(
        ((_PER_DOUBLING + part + 1) << shift) - 1
        for shift in range(1, 37)  # to 2**42 ns, 4,398 s
        for part in range(_PER_DOUBLING)
    ),
)
"""Upper limits in ns with 32 buckets per power of two: a percentile is at most 1/32 above the true value."""

_SHOWN_NS = tuple(digit * 10**power for power in range(2, 12) for digit in (1, 2, 5))
"""The limits that `Histogram.buckets_us` shows, from 0.1 us to 500 s; the last one has all longer durations."""


class Histogram:
    """A histogram of durations in nanoseconds. Each counts in the first bucket whose upper limit it does not exceed.

    `limits_ns` are the upper limits of the buckets, ascending and inclusive; one further bucket counts longer
    durations. `counts` has the counts of the buckets, each for its bucket alone, and `count` is their sum. `min_ns`,
    `max_ns` and `total_ns` are exact, and 0 before the first duration. A negative duration counts as 0.
    """

    def __init__(self, limits_ns: Sequence[int] = _FINE_NS, recent: int = 0) -> None:
        """Create an empty histogram. `recent` is the number of latest durations that `recent_longest_ns` covers."""
        self.limits_ns = limits_ns
        self.counts = [0] * (len(limits_ns) + 1)
        self.count = self.min_ns = self.max_ns = self.total_ns = 0
        self._recent: deque[int] = deque(maxlen=recent)

    def record(self, duration_ns: int) -> None:
        """Count one duration."""
        if duration_ns <= 0:  # in virtual time every scan takes 0 ns
            self.min_ns = 0
            self.count += 1
            self.counts[0] += 1
            self._recent.append(0)
            return
        if not self.count or duration_ns < self.min_ns:
            self.min_ns = duration_ns
        if duration_ns > self.max_ns:
            self.max_ns = duration_ns
        self.count += 1
        self.total_ns += duration_ns
        self.counts[bisect_left(self.limits_ns, duration_ns)] += 1
        self._recent.append(duration_ns)

    def record_zeros(self, times: int) -> None:
        """Count a duration of 0 several `times`."""
        self.min_ns = 0
        self.count += times
        self.counts[0] += times
        if self._recent.maxlen:
            self._recent.extend([0] * min(times, self._recent.maxlen))

    @property
    def recent_longest_ns(self) -> int:
        """Return the longest of the latest durations, or 0 before the first."""
        return max(self._recent, default=0)

    def percentile_ns(self, percent: float) -> int:
        """Return a percentile: the smallest limit with at least `percent` (0 to 100) of the durations at or below it.

        The result is at most the longest duration. Without durations it is 0.
        """
        need = self.count * percent / 100
        seen = 0
        for limit_ns, count in zip(self.limits_ns, self.counts, strict=False):
            seen += count
            if count and seen >= need:
                return min(limit_ns, self.max_ns)
        return self.max_ns

    def share_above(self, ns: int) -> float:
        """Return the share of all durations, 0 to 1, that are longer than the limit of the bucket of `ns`."""
        return sum(self.counts[bisect_left(self.limits_ns, ns) + 1 :]) / self.count if self.count else 0.0

    def summary_us(self) -> dict[str, Any]:
        """Return count, and min, p50, p99, p99.9, max in microseconds, and the share above 1 ms, as data for JSON."""
        return {
            "count": self.count,
            "min": self.min_ns / 1e3,
            "p50": self.percentile_ns(50) / 1e3,
            "p99": self.percentile_ns(99) / 1e3,
            "p999": self.percentile_ns(99.9) / 1e3,
            "above_1ms": self.share_above(NS_PER_MS),
            "max": self.max_ns / 1e3,
        }

    def buckets_us(self) -> list[tuple[float, int]]:
        """Return (upper limit in microseconds, count) for a display: limits of 1, 2 and 5 times a power of ten.

        The list begins with the first bucket and ends with the last one that has a count, at most 30. A duration near a limit
        may count in the next bucket, because the histogram's own limits differ.
        """
        counts: dict[int, int] = {}
        for at, count in enumerate(self.counts):
            if count:
                limit_ns = self.limits_ns[at] if at < len(self.limits_ns) else self.max_ns
                shown = bisect_left(_SHOWN_NS, limit_ns)
                counts[min(shown, len(_SHOWN_NS) - 1)] = counts.get(min(shown, len(_SHOWN_NS) - 1), 0) + count
        return [(_SHOWN_NS[n] / 1e3, counts.get(n, 0)) for n in range(min(counts), max(counts) + 1)] if counts else []


def response_times() -> Histogram:
    """Return an empty histogram for the response times on a bus: few buckets, and the longest of the last 64 durations."""
    return Histogram([ms * NS_PER_MS for ms in RESPONSE_MS], recent=64)
