"""A histogram of durations with limited memory and limited error: percentiles of millions of scans.

There are 32 buckets per power of two, so a percentile is at most 1/32 above the true value; minimum and maximum are
exact. This module must not know what is measured.
"""

from __future__ import annotations

from typing import Any

_SUB_BITS = 5
_SUB = 1 << _SUB_BITS
_MAX_BITS = 42  # 4,398 s in ns; a longer duration counts as this one
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
        """Return a duration that at least `percent` (0 to 100) of all do not exceed; 0 if there are none."""
        need = self.count * percent / 100
        seen = 0
        for bucket, count in enumerate(self._counts):
            seen += count
            if count and seen >= need:
                return min(_upper_ns(bucket), self.max_ns)
        return 0

    def share_above(self, ns: int) -> float:
        """Return the share of all durations, 0 to 1, that are longer than `ns` (with the accuracy of a bucket)."""
        if not self.count:
            return 0.0
        return sum(self._counts[_bucket(ns) + 1 :]) / self.count

    def summary_us(self) -> dict[str, Any]:
        """Return count, and min, p50, p99, p99.9, max in microseconds, and the share above 1 ms, as data for JSON."""
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
    """Return the longest duration of a bucket."""
    if bucket < _SUB:
        return bucket
    shift, sub = divmod(bucket, _SUB)
    return ((sub + _SUB + 1) << (shift - 1)) - 1
