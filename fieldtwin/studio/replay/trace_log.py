"""An index of a trace: the values of tags and variables over time, faults and steps. It follows a file that still grows.

Memory holds 18 bytes for each value. A trace may be from an untrusted source: lines, names and events are limited, and
reading ends at an invalid line with an error that gives its number.
"""

from __future__ import annotations

import os
from bisect import insort
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from fieldtwin.capture.formats.pcap import MAX_LINE_BYTES
from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.gateway.core.files.input_file import open_input
from fieldtwin.results.model import Verdict
from fieldtwin.results.trace import TraceKind, decode_event
from fieldtwin.studio.live.tag_history import Point
from fieldtwin.studio.replay.alarms import AlarmChange, change_of
from fieldtwin.studio.replay.series import Kind, Kinds, Series, encoded

AT_ONCE_BYTES = 256 * 1024
"""Number of bytes that one call of `follow` reads: some 2,000 events, which take about 10 ms."""
MOST_VALUES = 10_000_000
"""Largest number of events of tags and variables: 180 MB."""
MOST_NAMES = 20_000
MOST_EVENTS = 50_000
"""Largest number of fault events, of step events of scenarios, and of changes of alarms."""
LATE_NS = 60 * NS_PER_S
"""An event may be older than the latest one by at most this much (ns), because events of several processes are not exactly in
order."""
LONGEST_NS = 1 << 53
"""The latest time that a page can show exactly: 104 days."""
BAD_VERDICTS = frozenset(verdict.value for verdict in Verdict if verdict.bad)
EXPECTED = "[ns, kind, where, data], as `fieldtwin simulate --trace` writes it"


class FaultEvent(NamedTuple):
    """A fault was injected, or cleared. `data` is the data of the trace event."""

    t_ns: int
    id: str
    on: bool
    data: dict[str, Any]


class StepEvent(NamedTuple):
    """A step of a scenario began, or ended with a verdict."""

    t_ns: int
    number: str
    text: str
    verdict: str


class AfterCheck:
    """Separates a failed check from later actions of the run at the same instant, such as stopping the gateway.

    Those events are shown 1 ns later, so that the instant of the check shows the state that the check has examined.
    """

    def __init__(self) -> None:
        self._failed_ns = -1

    def time_of(self, t_ns: int, kind: TraceKind, data: Mapping[str, Any]) -> int:
        """Return the time at which an event is shown. Called once for each event, in order."""
        if kind is TraceKind.STEP and data.get("verdict") in BAD_VERDICTS:
            self._failed_ns = t_ns
            return t_ns
        return t_ns + 1 if t_ns == self._failed_ns else t_ns


class TraceLog:
    """The index of one trace. Raises `FileInvalid` if the file cannot be read."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.tags: dict[str, Series] = {}
        self.states: dict[str, Series] = {}
        self.faults: list[FaultEvent] = []
        self.steps: list[StepEvent] = []
        self.alarms: dict[str, list[AlarmChange]] = {}
        """The changes of each alarm in order of time, by its name in expressions."""
        self._alarm_events = 0
        self.last_ns = 0
        """The time of the latest event; the first one is at 0."""
        self.events = 0
        self.trouble: FileInvalid | None = None
        """The error at which reading ended before the end of the file, if any."""
        self.kinds = Kinds()
        self._after_check = AfterCheck()
        self._values = 0
        self._line = 0
        self._read_to = 0
        self._rest = b""
        try:
            self._file, self._lines = open_input(path), open_input(path)
        except OSError as e:
            raise FileInvalid(f"cannot read the trace: {e.strerror or e}", path=str(path)) from e

    def close(self) -> None:
        """Close the file."""
        self._file.close()
        self._lines.close()

    @property
    def is_replaced(self) -> bool:
        """Return whether the file was replaced by another file of the same name, or was written again from its beginning."""
        try:
            now, own = self.path.stat(), os.fstat(self._file.fileno())
        except OSError:
            return False
        return now.st_ino != own.st_ino or now.st_size < self._read_to

    @property
    def behind_bytes(self) -> int:
        """Return how many bytes of the file are not indexed yet; 0 after an invalid line, where the reading ends."""
        if self.trouble is not None:
            return 0
        try:
            return max(0, self.path.stat().st_size - self._read_to)
        except OSError:
            return 0

    def follow(self) -> bool:
        """Index the next piece of the file, at most `AT_ONCE_BYTES`. Return whether there was one."""
        if self.trouble is not None:
            return False
        chunk = self._file.read(AT_ONCE_BYTES)
        if not chunk:
            return False
        at = self._read_to - len(self._rest)
        self._read_to += len(chunk)
        *lines, self._rest = (self._rest + chunk).split(b"\n")
        try:
            for line in lines:
                self._line += 1
                self._check_length(line)
                self._add(line, at)
                self.events += 1
                at += len(line) + 1
            self._line += 1
            self._check_length(self._rest)
            self._line -= 1
        except FileInvalid as e:
            self.trouble = e
        except (msgspec.MsgspecError, ValueError, KeyError, RecursionError) as e:
            self.trouble = FileInvalid(f"no event: {e}", path=str(self.path), line=self._line, expected=EXPECTED)
        return True

    def point(self, series: Series, position: int) -> Point:
        """Return the event at a position of a series."""
        kind = self.kinds[series.kinds[position]]
        number = series.values[position]
        value: Any = None
        if kind.type == "t":
            value = self._text(int(number))
        elif kind.type != "n":
            value = number if kind.type == "f" else bool(number) if kind.type == "b" else int(number)
        return Point(series.times[position], value, kind.quality, kind.reason)

    def at(self, series: Series | None, t_ns: int) -> Point | None:
        """Return the event that was the latest one at an instant, None before the first one."""
        position = -1 if series is None else series.last_at(t_ns)
        return None if series is None or position < 0 else self.point(series, position)

    def _text(self, at: int) -> Any:
        """Read a value from its line in the file, which begins at byte `at`."""
        self._lines.seek(at)
        value = decode_event(self._lines.readline(MAX_LINE_BYTES)).data.get("value")
        return value if isinstance(value, str | int) else str(value)

    def _check_length(self, line: bytes) -> None:
        if len(line) > MAX_LINE_BYTES:
            raise ValueError(f"the line is longer than {MAX_LINE_BYTES} bytes")

    def _add(self, line: bytes, at: int) -> None:
        t_ns, kind, where, data = decode_event(line)
        if not 0 <= t_ns <= LONGEST_NS:
            raise ValueError(f"the time {t_ns} ns is not within a run")
        if t_ns < self.last_ns - LATE_NS:
            raise ValueError(f"the time is earlier than before by {(self.last_ns - t_ns) / NS_PER_S:g} s")
        t_ns = self._after_check.time_of(t_ns, kind, data)
        self.last_ns = max(self.last_ns, t_ns)
        match kind:
            case TraceKind.TAG:
                self._value(self.tags, where, t_ns, data, at)
            case TraceKind.STATE:
                self._value(self.states, where, t_ns, data, at)
            case TraceKind.FAULT:
                self._room(len(self.faults), MOST_EVENTS, "faults")
                self.faults.append(FaultEvent(t_ns, where, bool(data.get("on")), data))
            case TraceKind.ALARM:
                self._room(self._alarm_events, MOST_EVENTS, "alarms")
                self._alarm_events += 1
                insort(self.alarms.setdefault(where, []), change_of(t_ns, data), key=lambda change: change.t_ns)
            case TraceKind.STEP:
                self._room(len(self.steps), MOST_EVENTS, "steps")
                self.steps.append(StepEvent(t_ns, where, str(data.get("text", "")), str(data.get("verdict", ""))))

    def _value(self, of: dict[str, Series], where: str, t_ns: int, data: dict[str, Any], at: int) -> None:
        series = of.get(where)
        if series is None:
            self._room(len(self.tags) + len(self.states), MOST_NAMES, "names")
            series = of[where] = Series()
        self._room(self._values, MOST_VALUES, "values")
        self._values += 1
        type, number = encoded(data["value"], at)
        kind = Kind(type, str(data.get("quality", "")), str(data.get("reason", "")))
        series.add(t_ns, number, self.kinds.number(kind))

    def _room(self, count: int, most: int, what: str) -> None:
        if count >= most:
            raise FileInvalid(
                f"the trace has too many {what}", path=str(self.path), line=self._line, expected=f"at most {most}"
            )
