"""The response times of a device, in a histogram of constant size."""

from __future__ import annotations

from dataclasses import dataclass, field

PER_DECADE = 10
BUCKETS = 71
"""Upper bounds from 10 us to 100 s, ten a decade; the last one takes the rest."""


def bound_us(bucket: int) -> int:
    """Return the upper bound of a bucket in microseconds."""
    return round(10 * 10 ** (bucket / PER_DECADE))


_BOUNDS_US = [bound_us(i) for i in range(BUCKETS)]


@dataclass
class Histogram:
    """Latencies in microseconds, by logarithmic buckets; `least_us` and `most_us` exactly."""

    counts: list[int] = field(default_factory=lambda: [0] * (BUCKETS + 1))
    count: int = 0
    least_us: int = 0
    most_us: int = 0

    def add(self, us: int) -> None:
        low, high = 0, BUCKETS
        while low < high:
            middle = (low + high) // 2
            if us <= _BOUNDS_US[middle]:
                high = middle
            else:
                low = middle + 1
        self.counts[low] += 1
        self.least_us = us if not self.count else min(self.least_us, us)
        self.most_us = max(self.most_us, us)
        self.count += 1

    def percentile_us(self, share: float) -> int:
        """Return the smallest bound that covers `share` (0 to 1) of all samples, at most the largest sample; 0 for none."""
        left = share * self.count
        for bucket, count in enumerate(self.counts):
            left -= count
            if count and left <= 1e-9:
                return min(self.most_us, _BOUNDS_US[bucket] if bucket < BUCKETS else self.most_us)
        return self.most_us

    def describe(self) -> dict[str, object]:
        """Return plain data for JSON: `buckets` are pairs of upper bound in us (None: more) and count, without empty ones."""
        pairs = [(_BOUNDS_US[i] if i < BUCKETS else None, n) for i, n in enumerate(self.counts) if n]
        return {
            "count": self.count,
            "least_us": self.least_us,
            "p50_us": self.percentile_us(0.5),
            "p95_us": self.percentile_us(0.95),
            "most_us": self.most_us,
            "buckets": pairs,
        }
