"""The history of the tags and variables of a trace, with the interface of `fieldtwin.studio.live.tag_history.TagHistory`."""

from __future__ import annotations

from collections.abc import Collection

from fieldtwin.capture.decoding.exchange import SECRET
from fieldtwin.studio.live.tag_history import MOST_POINTS, Point, thinned
from fieldtwin.studio.replay.series import Series
from fieldtwin.studio.replay.trace_log import TraceLog

MOST_READ = 200_000
"""Largest number of events of one tag that are read for one answer. A longer range is first sampled at equal distances."""


class ReplayedHistory:
    """The changes of tags and variables, read from the index of a trace."""

    def __init__(self, log: TraceLog, secrets: Collection[str]) -> None:
        self._log = log
        self._secrets = secrets

    def at(self, name: str, t_ns: int) -> Point | None:
        """Return the point that was valid at an instant, None before the first one."""
        point = self._log.at(self._series(name), t_ns)
        return None if point is None else self._without_secret(name, point)

    def state_at(self, name: str, t_ns: int) -> Point | None:
        """Return the value of a program's variable at an instant, None before the first one. The PLC may write a tag that the
        gateway reads as well."""
        return self._log.at(self._log.states.get(name), t_ns)

    def changes(self, name: str, from_ns: int, to_ns: int) -> list[tuple[Point | None, Point]]:
        """Return the changes in an interval, each with the point before it."""
        series = self._series(name)
        if series is None:
            return []
        first, last = series.first_from(from_ns), series.last_at(to_ns)
        last = min(last, first + MOST_POINTS)
        points = [self._point(name, series, position) for position in range(max(0, first - 1), last + 1)]
        befores: list[Point | None] = [*([] if first > 0 else [None]), *points]
        return list(zip(befores, points if first == 0 else points[1:], strict=False))

    def between(self, name: str, from_ns: int, to_ns: int, points: int = MOST_POINTS) -> tuple[list[Point], bool]:
        """Return at most `points` points of an interval, and whether they were thinned out (see `TagHistory.between`)."""
        series = self._series(name)
        if series is None:
            return [], False
        first, last = max(0, series.last_at(from_ns)), series.last_at(to_ns)
        if last < first:
            return [], False
        step = (last - first) // MOST_READ + 1
        found = [self._point(name, series, position) for position in range(first, last + 1, step)]
        if len(found) <= points:
            return found, step > 1
        return thinned(found, from_ns, to_ns, max(1, points // 4)), True

    def _series(self, name: str) -> Series | None:
        return self._log.tags.get(name) or self._log.states.get(name)

    def _point(self, name: str, series: Series, position: int) -> Point:
        return self._without_secret(name, self._log.point(series, position))

    def _without_secret(self, name: str, point: Point) -> Point:
        return point._replace(value=SECRET) if name in self._secrets else point
