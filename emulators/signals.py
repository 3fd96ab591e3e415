"""Signals over time, such as a recorded cast or trajectory, read at the time of the emulator's clock.

A `SignalTrack` is the recording in memory (arrays of doubles: 65,158 rows of three signals take 2 MB); a `SignalPlayer`
plays it from a start time, at a speed, and handles its end. The caller passes the time to both, and neither depends
on the register or object that holds a signal.
"""

from __future__ import annotations

import math
from array import array
from bisect import bisect_right
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Protocol

from fieldtwin.emulators.context import EndOfRecording, UsedUp
from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.errors import FileInvalid, UsageError
from fieldtwin.gateway.core.files.recording import RecordingReader, SignalRow

MAX_NUMBERS = 16_000_000
"""The largest number of times and values of one track: 128 MB, or 46 hours of three signals at 24 Hz. A longer recording is
refused.
"""


class SignalTrack:
    """Signals over time, interpolated linearly between rows. Seconds count from the recording's start.

    NaN means "no value"; between a row and a NaN there is no value either. Two rows with the same time form a step.
    """

    def __init__(self, names: Iterable[str], rows: Iterable[SignalRow], *, units: Iterable[str] = (), path: str = ""):
        self.names = tuple(names)
        self.units = tuple(units) or ("",) * len(self.names)
        self.path = path
        self._index = {name: i for i, name in enumerate(self.names)}
        self._times = array("d")
        self._columns = tuple(array("d") for _ in self.names)
        width = len(self.names) + 1
        for row in rows:
            if (len(self._times) + 1) * width > MAX_NUMBERS:
                raise FileInvalid(
                    "the recording is too long to be played", path=path, expected=f"{MAX_NUMBERS} numbers"
                )
            self._times.append(row.t_s)
            for column, value in zip(self._columns, row.values, strict=True):
                column.append(value)
        if not self._times:
            raise FileInvalid("the recording holds no rows", path=path, expected="at least one")
        self.first_s = self._times[0]
        """The time of the first row, in seconds."""
        self.last_s = self._times[-1]
        """The time of the last row, in seconds."""

    @classmethod
    def load(cls, path: Path) -> SignalTrack:
        """Read a recording of signals; raises `FileInvalid`. A truncated last line is left out."""
        with RecordingReader(path) as reader:
            signals = reader.header.signals
            units = [info.unit for info in signals.values()]
            return cls(signals, reader.rows(), units=units, path=str(path))

    def __len__(self) -> int:
        return len(self._times)

    @property
    def nbytes(self) -> int:
        """Return the memory that the numbers take, in bytes."""
        return sum(numbers.buffer_info()[1] * numbers.itemsize for numbers in (self._times, *self._columns))

    def at(self, t_s: float, name: str) -> float:
        """Return the value of `name` at `t_s` (s): the first value before the first row, the last value after the last row."""
        return self._interpolate(self._columns[self._column(name)], *self._locate(t_s))

    def nearest_s(self, values: Mapping[str, float]) -> float | None:
        """Return the time of the row nearest to `values`, or None if none of them is a signal of this track.

        Each distance is relative to the range of its signal. Of equally near rows the earliest is used.
        """
        distances = array("d", bytes(8 * len(self._times)))
        known = False
        for name, wanted in values.items():
            if name not in self._index or math.isnan(wanted):
                continue
            column = self._columns[self._index[name]]
            there = [value for value in column if not math.isnan(value)]
            if not there:
                continue
            known = True
            spread = (max(there) - min(there)) or 1.0
            for row, value in enumerate(column):
                distances[row] += 1.0 if math.isnan(value) else ((value - wanted) / spread) ** 2
        return self._times[distances.index(min(distances))] if known else None

    def values(self, t_s: float) -> dict[str, float]:
        """Return the values of all signals at `t_s`."""
        row, fraction = self._locate(t_s)
        columns = self._columns
        if fraction == 0.0:
            numbers = [column[row] for column in columns]
        else:
            numbers = [column[row] + (column[row + 1] - column[row]) * fraction for column in columns]
        return dict(zip(self.names, numbers, strict=True))

    def _column(self, name: str) -> int:
        try:
            return self._index[name]
        except KeyError:
            raise FileInvalid(
                "the recording has no such signal", path=self.path, expected=", ".join(self.names), got=name
            ) from None

    def _locate(self, t_s: float) -> tuple[int, float]:
        """Return the row at or before `t_s`, and the fraction of the way to the next one, 0 to less than 1."""
        after = bisect_right(self._times, t_s)
        if after == 0:
            return 0, 0.0
        if after == len(self._times):
            return after - 1, 0.0
        t0, t1 = self._times[after - 1], self._times[after]
        return after - 1, (t_s - t0) / (t1 - t0)

    @staticmethod
    def _interpolate(column: array[float], row: int, fraction: float) -> float:
        here = column[row]
        return here if fraction == 0.0 else here + (column[row + 1] - here) * fraction


class Signals(Protocol):
    """The signals of a device: values by name as a function of the emulator's time, from a recording or a simulation."""

    names: tuple[str, ...]
    path: str
    start_ns: int

    def __len__(self) -> int: ...

    def position_s(self, now_ns: int) -> float:
        """Return the position of `now_ns` in the recording or simulation, in seconds since its start."""
        ...

    def values(self, now_ns: int) -> dict[str, float]:
        """Return the present values of all signals, all taken at the same time."""
        ...

    def values_at(self, position_s: float) -> dict[str, float]:
        """Return the values of all signals at a position that `position_s` returned. For a simulation, it may not be earlier
        than a position that was used before.
        """
        ...

    def begin_with(self, values: Mapping[str, float], now_ns: int) -> bool:
        """Continue from the state that is nearest to `values`. Return False if this is not possible."""
        ...

    def at(self, now_ns: int, name: str) -> float:
        """Return the present value of one signal, or NaN if it has none. Raises `FileInvalid` for an unknown name."""
        ...


class SignalPlayer(Signals):
    """A track played from `start_ns` on, `speed` times as fast as recorded. Reading never changes it.

    After the last row, `HOLD` keeps its values, and `ERROR` raises `UsedUp`. `LOOP` continues with the first row, which counts as
    the same instant as the last row (a recording for looping ends with its first values).
    """

    def __init__(
        self, track: SignalTrack, start_ns: int, *, speed: float = 1.0, at_end: EndOfRecording = EndOfRecording.HOLD
    ) -> None:
        if not (speed > 0 and math.isfinite(speed)):
            raise UsageError("a recording cannot be played at that speed", expected="more than 0", got=str(speed))
        self.track = track
        self.names = track.names
        self.path = track.path
        self.start_ns = start_ns
        self.speed = speed
        self.at_end = at_end

    def position_s(self, now_ns: int) -> float:
        """Return the position of `now_ns` in the recording, in the recording's seconds; raises `UsedUp` under `ERROR`."""
        t_s = (now_ns - self.start_ns) / NS_PER_S * self.speed
        first, last = self.track.first_s, self.track.last_s
        if t_s <= last:
            return t_s
        if self.at_end is EndOfRecording.ERROR:
            raise UsedUp("the recording has ended", path=self.track.path, got=f"{t_s:.3f} s of {last:.3f} s")
        if self.at_end is EndOfRecording.LOOP and last > first:
            return first + math.fmod(t_s - first, last - first)
        return last

    def ended(self, now_ns: int) -> bool:
        """Return whether `now_ns` is after the last row (under `LOOP`: after its first pass)."""
        return (now_ns - self.start_ns) / NS_PER_S * self.speed > self.track.last_s

    def at(self, now_ns: int, name: str) -> float:
        """Return the present value of the signal `name`, or NaN if the recording has none."""
        return self.track.at(self.position_s(now_ns), name)

    def values(self, now_ns: int) -> dict[str, float]:
        """Return the present values of all signals, all taken at the same time."""
        return self.track.values(self.position_s(now_ns))

    def begin_with(self, values: Mapping[str, float], now_ns: int) -> bool:
        nearest_s = self.track.nearest_s(values)
        if nearest_s is None:
            return False
        self.start_ns = now_ns - round(nearest_s / self.speed * NS_PER_S)
        return True

    def values_at(self, position_s: float) -> dict[str, float]:
        """Return the values of all signals at a time of the recording."""
        return self.track.values(position_s)

    def __len__(self) -> int:
        return len(self.track)
