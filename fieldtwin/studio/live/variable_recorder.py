"""Record variables of a running PLC after each scan, for pages that show them.

The PLC keeps the values in the rings of its traces (`fieldtwin.plc.runtime.tracing`), which are read here before they are
overwritten. One trace has the variables of all programs of a task, whichever client shows them. If a variable is added, a new
trace begins before the old one is read to its end, so that no scan between them is missing.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any

from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.control import RemoteError
from fieldtwin.gateway.core.errors import FieldtwinError, UsageError
from fieldtwin.plc.runtime.variable_trace import MAX_VARIABLES
from fieldtwin.studio.live.tag_history import BAD, GOOD, MOST_POINTS, Point, thinned
from fieldtwin.twin.plant.channel import Channel

MOST_SCANS = 20_000
"""The largest number of scans of a variable that are kept: 200 s with a scan every 10 ms. 32 variables take about 40 MB."""
NOT_RECORDED = "not_recorded"
"""The reason of a time whose scans are missing."""
RING_SCANS = 2_000
"""The size of a ring in the PLC in scans: 2 s with a scan every 1 ms."""
READ_EVERY_S = 0.25
AGAIN_AFTER_S = 1.0
"""Pause in seconds before a PLC that did not answer is queried again."""
KEPT_NS = 60 * NS_PER_S
"""The recording of a variable ends after this time without a request."""


class VariableHistory:
    """The values of one variable, the oldest ones dropped first. `missed` counts scans that could not be recorded."""

    def __init__(self, name: str, type: str, unit: str) -> None:
        self.name = name
        self.type = type
        """The IEC type, or the kind of the tag."""
        self.unit = unit
        self.missed = 0
        self.dropped = 0
        """The number of scans that were recorded, and have left the ring."""
        self._times: deque[int] = deque(maxlen=MOST_SCANS)
        self._values: deque[Any] = deque(maxlen=MOST_SCANS)
        self._gaps: deque[int] = deque(maxlen=MOST_SCANS)
        """The times of scans after which scans are missing."""

    @property
    def last_ns(self) -> int:
        """Return the time of the last scan (monotonic, ns), 0 without one."""
        return self._times[-1] if self._times else 0

    def add(self, t_ns: int, value: Any) -> None:
        """Add the value after the scan at `t_ns`. An equal value takes no further memory."""
        if len(self._times) == MOST_SCANS:
            self.dropped += 1
            while self._gaps and self._gaps[0] <= self._times[0]:
                self._gaps.popleft()
        before = self._values[-1] if self._values else None
        self._times.append(t_ns)
        self._values.append(before if type(before) is type(value) and before == value else value)

    def miss(self, scans: int = 0) -> None:
        """Note that scans after the last one are missing. How many is not always known."""
        self.missed += scans
        if self._times and (not self._gaps or self._gaps[-1] != self._times[-1]):
            self._gaps.append(self._times[-1])

    def between(self, from_ns: int, to_ns: int, points: int = MOST_POINTS) -> dict[str, Any]:
        """Return the values of an interval as data for JSON: `points`, the number of `scans`, and how many of them are `shown`.

        A scan that repeats a value adds no point. More than `points` values are thinned out as those of tags are. The
        first point is the value that was valid at the beginning.
        """
        found: list[Point] = []
        scans = 0
        gaps = set(self._gaps)
        for t_ns, value in zip(self._times, self._values, strict=True):
            if t_ns > to_ns:
                break
            if t_ns <= from_ns:
                found.clear()
            scans += t_ns >= from_ns
            last = found[-1] if found else None
            if last is None or last.value is not value or last.quality != GOOD:
                found.append(_point(t_ns, value))
            if t_ns in gaps:
                found.append(Point(t_ns + 1, None, BAD, NOT_RECORDED))
        kept = thinned(found, from_ns, to_ns, max(1, points // 4)) if len(found) > points else found
        return {
            "points": [list(point) for point in kept],
            "thinned": len(kept) < len(found),
            "scans": scans,
            "shown": scans if len(kept) == len(found) else len(kept),
        }


def _point(t_ns: int, value: Any) -> Point:
    return Point(t_ns, value, BAD, "no_value") if value is None else Point(t_ns, value, GOOD, "none")


@dataclass
class _Recording:
    """The recording of the variables of one task. `number` is that of the trace in the PLC, None while it has none."""

    number: int | None = None
    next_row: int = 0
    histories: list[VariableHistory] = field(default_factory=list)
    """In the order of the columns of the trace."""


class VariableRecorder:
    """The recorded variables of one instance. `task_of` returns the task of a program."""

    def __init__(self, channel: Channel, task_of: Callable[[str], str], now_ns: Callable[[], int]) -> None:
        self._channel, self._task_of, self._now_ns = channel, task_of, now_ns
        self._recordings: dict[str, _Recording] = {}
        self._requested_ns: dict[str, int] = {}
        """When a client last requested each variable."""
        self._lock = asyncio.Lock()

    async def history(self, name: str) -> VariableHistory:
        """Return the history of a variable ``PROGRAM.PATH``; recording begins with the first request.

        Raises `UsageError` for too many variables, and `RemoteError` or `Unreachable` as `Channel.call` does.
        """
        async with self._lock:
            task = self._task_of(name.partition(".")[0])
            recording = self._recordings.setdefault(task, _Recording())
            found = next((one for one in recording.histories if one.name == name), None)
            if found is None:
                if len(self._requested_ns) >= MAX_VARIABLES:
                    hint = f"a variable that is not shown for {KEPT_NS // NS_PER_S} s is no longer recorded"
                    raise UsageError("too many variables", expected=f"at most {MAX_VARIABLES} at a time", hint=hint)
                await self._record(recording, [*(one.name for one in recording.histories), name])
                found = recording.histories[-1]
            self._requested_ns[name] = self._now_ns()
            return found

    async def follow(self) -> None:
        """Read new rows again and again. It ends only by cancellation."""
        while True:
            pause_s = READ_EVERY_S
            for recording in list(self._recordings.values()):
                async with self._lock:
                    try:
                        await self._refresh(recording)
                    except FieldtwinError:
                        _miss(recording.histories)
                        pause_s = AGAIN_AFTER_S
            await asyncio.sleep(pause_s)

    async def _refresh(self, recording: _Recording) -> None:
        """Read new rows of a recording, and remove the variables that no client shows."""
        oldest_ns = self._now_ns() - KEPT_NS
        wanted = [one.name for one in recording.histories if self._requested_ns[one.name] >= oldest_ns]
        if len(wanted) < len(recording.histories):
            for one in recording.histories:
                if one.name not in wanted:
                    del self._requested_ns[one.name]
            await self._record(recording, wanted)
        elif recording.number is None and wanted:
            await self._record(recording, await self._present(wanted))
        elif recording.number is not None:
            try:
                await self._read(recording)
            except RemoteError:  # the PLC was restarted, and has no such trace
                recording.number = None
                _miss(recording.histories)

    async def _record(self, recording: _Recording, names: list[str]) -> None:
        """Record these variables from now on, and read the trace of those before to its end."""
        begun = await self._begin(names) if names else None
        if recording.number is not None:
            try:
                await self._read(recording)
                await self._channel.call("trace_end", number=recording.number)
            except FieldtwinError:
                _miss(recording.histories)
        known = {one.name: one for one in recording.histories}
        recording.number, recording.next_row, recording.histories = None, 0, []
        if begun is not None:
            recording.number = begun["number"]
            recording.histories = [
                known.get(one["name"]) or VariableHistory(one["name"], one["type"], one["unit"])
                for one in begun["variables"]
            ]

    async def _begin(self, names: Iterable[str]) -> Any:
        return await self._channel.call("trace_begin", names=list(names), before=RING_SCANS, after=0, when="")

    async def _present(self, names: list[str]) -> list[str]:
        """Return the variables that the PLC still has: after a restart its programs may be different."""
        found = []
        for name in names:
            try:
                begun = await self._begin([name])
            except RemoteError:
                continue
            await self._channel.call("trace_end", number=begun["number"])
            found.append(name)
        for name in set(names) - set(found):
            self._requested_ns.pop(name, None)
        return found

    async def _read(self, recording: _Recording) -> None:
        """Read all rows that exist, a limited number at a time."""
        while True:
            answer = await self._channel.call("trace_read", number=recording.number, since=recording.next_row)
            for number, _, t_ns, *values in answer["rows"]:
                missed, recording.next_row = number - recording.next_row, number + 1
                if missed:
                    _miss(recording.histories, missed)
                for one, value in zip(recording.histories, values, strict=True):
                    if t_ns > one.last_ns:  # the trace before had the other ones
                        one.add(t_ns, value)
            if recording.next_row >= answer["next_row"]:
                return


def _miss(histories: Iterable[VariableHistory], scans: int = 0) -> None:
    for one in histories:
        one.miss(scans)
