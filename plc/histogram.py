"""A histogram of durations with bounded memory and bounded error: percentiles of millions of scans.

Buckets are 32 to a power of two, so a percentile is at most 1/32 above the truth; minimum and maximum are exact. It
must never know what is measured.
"""

from __future__ import annotations

from typing import Any

_SUB_BITS = 5
_SUB = 1 << _SUB_BITS
_MAX_BITS = 42  # 4,398 s in ns; anything longer counts as that
_BUCKETS = (_MAX_BITS - _SUB_BITS + 1) * _SUB


class Histogram:
    """Counts durations in nanoseconds; negative ones count as 0."""

    def __init__(self) -> None:
        self._counts = [0] * _BUCKETS
        self.count = 0
        self.min_ns = 0
        self.max_ns = 0

    def record(self, duration_ns: int) -> None:
        """Count one duration."""
        ns = duration_ns if duration_ns > 0 else 0
        if not self.count or ns < self.min_ns:
            self.min_ns = ns
        if ns > self.max_ns:
            self.max_ns = ns
        self.count += 1
        self._counts[ns if ns < _SUB else _bucket(ns)] += 1

    def percentile_ns(self, percent: float) -> int:
        """A duration that at least `percent` of all do not exceed (0 to 100); 0 when there are none."""
        need = self.count * percent / 100
        seen = 0
        for bucket, count in enumerate(self._counts):
            seen += count
            if count and seen >= need:
                return min(_upper_ns(bucket), self.max_ns)
        return 0

    def share_above(self, ns: int) -> float:
        """The share of all, 0 to 1, that took longer than `ns` (to the bucket)."""
        if not self.count:
            return 0.0
        return sum(self._counts[_bucket(ns) + 1 :]) / self.count

    def summary_us(self) -> dict[str, Any]:
        """JSON-able: count, and min, p50, p99, p99.9, max in microseconds, and the share above 1 ms."""
        return {
            "count": self.count,
            "min": self.min_ns / 1e3,
            "p50": self.percentile_ns(50) / 1e3,
            "p99": self.percentile_ns(99) / 1e3,
            "p999": self.percentile_ns(99.9) / 1e3,
            "above_1ms": self.share_above(1_000_000),
            "max": self.max_ns / 1e3,
        }


def _bucket(ns: int) -> int:
    shift = ns.bit_length() - _SUB_BITS - 1
    if shift < 0:
        return ns
    return min((shift + 1) * _SUB + (ns >> shift) - _SUB, _BUCKETS - 1)


def _upper_ns(bucket: int) -> int:
    """The longest duration of a bucket."""
    if bucket < _SUB:
        return bucket
    shift, sub = divmod(bucket, _SUB)
    return ((sub + _SUB + 1) << (shift - 1)) - 1
