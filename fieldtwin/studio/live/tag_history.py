"""The history of tags: the latest changes of each tag, with quality and reason, thinned out if a diagram has no room for all."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Iterable
from typing import Any, NamedTuple, Protocol

from fieldtwin.gateway.core.clock import NS_PER_S

MOST_CHANGES = 2_000_000
"""Largest number of changes that are kept of all tags together: about 300 MB."""
MOST_OF_A_TAG = 100_000
LEAST_OF_A_TAG = 1_000
MOST_POINTS = 5_000
"""Largest number of points in one answer."""
RECENT_NS = 60 * NS_PER_S
MOST_RECENT = 120
"""Largest number of points of the last minute of a tag in one answer."""
MOST_RECENT_OF_ALL = 50_000
"""Largest number of points of all tags of the last minute in one answer: about 1.5 MB. Above 417 tags, each has fewer."""

GOOD = "good"
BAD = "bad"


class Point(NamedTuple):
    """A value from `t_ns` on, until the next point. `t_ns` counts on the run's monotonic clock."""

    t_ns: int
    value: Any
    quality: str
    reason: str


class Points(Protocol):
    """The history of tags, of a running instance or of a trace."""

    def between(self, name: str, from_ns: int, to_ns: int, points: int = MOST_POINTS) -> tuple[list[Point], bool]:
        """Return the points of a tag in an interval, at most `points`, and whether they were thinned out."""


def recent(history: Points, names: Collection[str], t_ns: int) -> dict[str, list[tuple[int, float | None]]]:
    """Return for each tag its numbers in the minute before `t_ns` as (time in ns, number); None for a value that is not good.

    A tag has at most `MOST_RECENT` points, and all together have about `MOST_RECENT_OF_ALL`. A tag with text values has none.
    """
    most = max(4, min(MOST_RECENT, MOST_RECENT_OF_ALL // max(1, len(names))))
    found = {}
    for name in names:
        points, _ = history.between(name, max(0, t_ns - RECENT_NS), t_ns, most)
        is_text = any(isinstance(point.value, str) for point in points)
        found[name] = [] if is_text else [(p.t_ns, _number(p)) for p in points]
    return found


def _number(point: Point) -> float | None:
    return float(point.value) if point.quality == GOOD and isinstance(point.value, int | float) else None


class TagHistory:
    """The changes of the tags of one run, the oldest ones dropped first."""

    def __init__(self, names: Iterable[str]) -> None:
        names = list(names)
        room = min(MOST_OF_A_TAG, max(LEAST_OF_A_TAG, MOST_CHANGES // max(1, len(names))))
        self._points: dict[str, deque[Point]] = {name: deque(maxlen=room) for name in names}

    def add(self, name: str, point: Point) -> None:
        """Add a change. Tags that are not in the system are ignored."""
        points = self._points.get(name)
        if points is not None:
            points.append(point)

    def latest(self, name: str) -> Point | None:
        """Return the latest point of a tag, None before the first one."""
        points = self._points[name]
        return points[-1] if points else None

    def names(self) -> list[str]:
        """Return the names of all tags."""
        return list(self._points)

    def at(self, name: str, t_ns: int) -> Point | None:
        """Return the point that was valid at an instant, None before the first one."""
        return next((point for point in reversed(self._points[name]) if point.t_ns <= t_ns), None)

    def changes(self, name: str, from_ns: int, to_ns: int) -> list[tuple[Point | None, Point]]:
        """Return the changes of a tag in an interval, each with the point before it. A tag that is not in the system has none."""
        found: list[tuple[Point | None, Point]] = []
        later: Point | None = None
        for point in reversed(self._points.get(name, ())):
            if later is not None:
                found.append((point, later))
                later = None
            if point.t_ns < from_ns:
                break
            if point.t_ns <= to_ns:
                later = point
        if later is not None:
            found.append((None, later))
        return found[::-1]

    def between(self, name: str, from_ns: int, to_ns: int, points: int = MOST_POINTS) -> tuple[list[Point], bool]:
        """Return the points of a tag in an interval, at most `points`, and whether they were thinned out.

        The first one is the point that was valid at the beginning. For each part of the interval, thinning keeps the
        first, the smallest, the largest and the last value, and every change of quality.
        """
        found: list[Point] = []
        for point in reversed(self._points[name]):
            if point.t_ns > to_ns:
                continue
            found.append(point)
            if point.t_ns <= from_ns:
                break
        found.reverse()
        if len(found) <= points:
            return found, False
        return thinned(found, from_ns, to_ns, max(1, points // 4)), True


def thinned(points: list[Point], from_ns: int, to_ns: int, parts: int) -> list[Point]:
    """Return at most about four points for each of `parts` equal parts of the interval, and all changes of quality."""
    width_ns = max(1, (to_ns - from_ns) // parts)
    kept: list[Point] = []
    bucket: list[Point] = []
    number = -1
    for point in points:
        here = max(0, point.t_ns - from_ns) // width_ns
        changed = bucket and (point.quality, point.reason) != (bucket[-1].quality, bucket[-1].reason)
        if here != number or changed:
            kept += _extremes(bucket)
            bucket, number = [], here
        bucket.append(point)
    return kept + _extremes(bucket)


def _extremes(bucket: list[Point]) -> list[Point]:
    if len(bucket) <= 4:
        return bucket
    numbers = [p for p in bucket if isinstance(p.value, int | float)]
    chosen = {bucket[0], bucket[-1]}
    if numbers:
        chosen |= {min(numbers, key=lambda p: p.value), max(numbers, key=lambda p: p.value)}
    return sorted(chosen, key=lambda p: p.t_ns)
