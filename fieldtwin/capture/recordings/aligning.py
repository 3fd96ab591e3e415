"""Find the position at which a live dialogue continues a recorded one, for each register and bit.

An emulator of a recording gives each register and bit its recorded values one after the other. If it was read before, its
values come from further on in the recording; a comparison by position would then report differences for the same device. So
where exchanges differ, the live values are looked up in the recorded ones. A shifted match counts only if it is exact and
contains at least two different values: a device with a constant value, or a different device, matches nothing. Values after
the end of the recorded ones are not compared. The module does no I/O.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from fieldtwin.capture.decoding.exchange import TouchedSpan
from fieldtwin.capture.decoding.modbus_pdu import parse_reply, parse_request, words
from fieldtwin.gateway.core.files.recording import RecordedExchange

MOST_WORDS = 1_000_000
"""Maximum number of values of both sides that are kept; a longer dialogue is compared position by position."""
LEAST_DIFFERENT = 2
"""The smallest number of different values that a shifted match must contain."""

Cell = tuple[int, str, int]
"""A register or bit of a device: unit ID, table and address."""


@dataclass(frozen=True, slots=True)
class Shift:
    """The position at which the values of a cell continue the recorded ones.

    `at` is the index of the first live value in the recorded values, `recorded` the number of recorded values, and `compared` the
    number of values that were compared.
    """

    unit: int
    where: str
    at: int
    recorded: int
    compared: int


@dataclass(frozen=True, slots=True)
class Aligned:
    """A recorded and a live exchange to be compared. `recorded` None: the recording has no value at that position to compare
    with.
    """

    recorded: RecordedExchange | None
    other: RecordedExchange


@dataclass(slots=True)
class _Series:
    recorded: list[int] = field(default_factory=list)
    other: list[int] = field(default_factory=list)
    asked: set[bytes] = field(default_factory=set)
    shift: int = 0
    sure: bool = True
    wraps: bool = False
    """The recorded values begin again after their end."""
    foreign: bool = False
    """The live values do not occur in the recorded ones: they are compared position by position."""

    def expected(self, index: int) -> int | None:
        """Return the recorded value for the live value `index`, None if there is none."""
        if not self.sure:
            return None
        at = self.shift + index
        if at < len(self.recorded):
            return self.recorded[at]
        return self.recorded[at % len(self.recorded)] if self.wraps else None

    @property
    def tail(self) -> list[int]:
        """Return the live values after the end of the recorded values."""
        return self.other[len(self.recorded) - self.shift :]

    @property
    def may_wrap(self) -> bool:
        """Return whether the tail equals the beginning of the recorded values."""
        return bool(self.tail) and self.tail == self.recorded[: len(self.tail)]

    @property
    def holds(self) -> bool:
        """Return whether the tail repeats the last recorded value."""
        return all(value == self.recorded[-1] for value in self.tail)

    def fits(self, shift: int) -> bool:
        """Return whether all live values are recorded from `shift` on.

        After the end of the recording they must repeat its beginning or hold its last value.
        """
        size = len(self.recorded) - shift
        overlap, tail = self.other[:size], self.other[size:]
        if overlap != self.recorded[shift : shift + len(overlap)]:
            return False
        return tail == self.recorded[: len(tail)] or all(value == self.recorded[-1] for value in tail)

    def shows(self, shift: int) -> bool:
        """Return whether the match at `shift` has enough different values that it is not a coincidence."""
        size = len(self.recorded) - shift
        tail = self.other[size:]
        begins_again = tail == self.recorded[: len(tail)] and any(value != self.recorded[-1] for value in tail)
        return len(set(self.other if begins_again else self.other[:size])) >= LEAST_DIFFERENT


class Dialogue:
    """Pairs of a recorded exchange and the live exchange of the same request, in order.

    `rest` receives recorded exchanges that were not repeated.
    """

    def __init__(self) -> None:
        self._pairs: list[tuple[RecordedExchange, RecordedExchange]] = []
        self._cells: dict[Cell, _Series] = {}
        self._words = 0
        self.shifts: list[Shift] = []

    @property
    def is_full(self) -> bool:
        """Return whether the limit is reached: then everything is compared position by position."""
        return self._words >= MOST_WORDS

    def add(self, recorded: RecordedExchange, other: RecordedExchange) -> None:
        """Add one pair of exchanges."""
        self._pairs.append((recorded, other))
        both = _values(recorded), _values(other)
        if both[0] is None or both[1] is None or len(both[0][1]) != len(both[1][1]):
            return
        span, values = both[0]
        for at, (mine, theirs) in enumerate(zip(values, both[1][1], strict=True)):
            series = self._cells.setdefault((recorded.unit, span.table, span.address + at), _Series())
            series.recorded.append(mine)
            series.other.append(theirs)
            series.asked.add(recorded.request)
        self._words += 2 * len(values)

    def rest(self, recorded: RecordedExchange) -> None:
        """Add a recorded exchange that follows the last one whose request was repeated."""
        if (found := _values(recorded)) is None:
            return
        span, values = found
        for at, value in enumerate(values):
            if (series := self._cells.get((recorded.unit, span.table, span.address + at))) is not None:
                series.recorded.append(value)
        self._words += len(values)

    def aligned(self, alike: Callable[[RecordedExchange, RecordedExchange], bool]) -> list[Aligned]:
        """Return all pairs, each with the recorded exchange at the position that was found; fills `shifts`.

        Exchanges that are equal at the same position (`alike`) are not searched for at other positions.
        """
        differ = {(one.unit, one.request) for one, other in self._pairs if not alike(one, other)}
        if self.is_full or not differ or not self._shift_all(differ):
            return [Aligned(recorded, other) for recorded, other in self._pairs]
        seen: dict[Cell, int] = {}
        return [Aligned(self._expected(recorded, other, seen), other) for recorded, other in self._pairs]

    def _shift_all(self, differ: set[tuple[int, bytes]]) -> bool:
        """Find the position of each cell that is read by a request of `differ`. Return whether any cell is shifted."""
        established: dict[bytes, set[int]] = {}
        unclear = []
        for (unit, _, _), series in self._cells.items():
            same = series.other == series.recorded[: len(series.other)]
            if same or not any((unit, request) in differ for request in series.asked):
                continue
            candidates = [shift for shift in _overlaps(series.other, series.recorded) if shift and series.fits(shift)]
            if shown := next((shift for shift in candidates if series.shows(shift)), None):
                series.shift = shown
                for request in series.asked:
                    established.setdefault(request, set()).add(shown)
            elif candidates:
                unclear.append((series, candidates))
            else:
                series.foreign = True
        for series, candidates in unclear:
            beside = set[int]().union(*(established.get(request, set()) for request in series.asked))
            series.shift = next((shift for shift in candidates if shift in beside), candidates[0])
            series.sure = series.shift in beside
        self._wrap_all()
        for (unit, table, address), series in self._cells.items():
            if series.shift:
                compared = sum(series.expected(index) is not None for index in range(len(series.other)))
                self.shifts.append(Shift(unit, f"{table}:{address}", series.shift, len(series.recorded), compared))
        return bool(self.shifts)

    def _wrap_all(self) -> None:
        """Find the cells whose values repeat from the beginning after their end.

        Where the first and the last value are equal, a cell that is read together with it and is at the same position
        decides.
        """
        moved = [series for series in self._cells.values() if series.shift and series.sure and series.may_wrap]
        certain = {(request, s.shift) for s in moved if not s.holds for request in s.asked}
        for series in moved:
            series.wraps = any((request, series.shift) in certain for request in series.asked)

    def _expected(
        self, recorded: RecordedExchange, other: RecordedExchange, seen: dict[Cell, int]
    ) -> RecordedExchange | None:
        """Return the recorded exchange, its values replaced by the recorded values at the positions that were found."""
        both = _values(recorded), _values(other)
        if both[0] is None or both[1] is None or len(both[0][1]) != len(both[1][1]):
            return recorded
        span = both[0][0]
        expected: list[int] = []
        foreign = False
        for at in range(len(both[0][1])):
            cell = (recorded.unit, span.table, span.address + at)
            index = seen[cell] = seen.get(cell, -1) + 1
            value = self._cells[cell].expected(index)
            expected.append(-1 if value is None else value)
            foreign = foreign or self._cells[cell].foreign
        if foreign:
            return recorded
        if -1 in expected:
            return None
        reply = _reply(recorded.request[0], expected)
        return RecordedExchange(recorded.t_s, recorded.unit, recorded.request, reply, recorded.latency_s)


def _values(exchange: RecordedExchange) -> tuple[TouchedSpan, list[int]] | None:
    """Return the values of the reply to a plain read (functions 01 to 04); None for anything else."""
    if not exchange.reply or not 1 <= exchange.request[0] <= 4:
        return None
    asked = parse_request(exchange.request)
    answer = parse_reply(asked, exchange.request, exchange.reply)
    if asked.read_span is None or answer.problem or answer.exception is not None or not answer.read:
        return None
    return asked.read_span, list(words(asked.read_span, answer.read))


def _reply(function: int, values: Sequence[int]) -> bytes:
    """Return the reply to a read with these values (AP 6.1 to 6.4)."""
    if function in (3, 4):
        data = b"".join(value.to_bytes(2) for value in values)
    else:
        data = bytes(
            sum(bit << place for place, bit in enumerate(values[at : at + 8])) for at in range(0, len(values), 8)
        )
    return bytes((function, len(data))) + data


def _overlaps(live: Sequence[int], recorded: Sequence[int]) -> list[int]:
    """Return the ascending positions in `recorded` from which it equals `live`, up to the end of the shorter of the two.

    The time is linear in the lengths of both (Knuth, Morris, Pratt).
    """
    if not live:
        return []
    borders = _borders(live)
    found, length = [], 0
    for at, value in enumerate(recorded):
        while length and (length == len(live) or live[length] != value):
            length = borders[length - 1]
        if live[length] == value:
            length += 1
        if length == len(live):
            found.append(at + 1 - length)
    while length:
        if len(recorded) - length not in found:
            found.append(len(recorded) - length)
        length = borders[length - 1]
    return sorted(found)


def _borders(values: Sequence[int]) -> list[int]:
    """Return for each prefix the length of the longest proper prefix that is also its suffix."""
    borders, length = [0] * len(values), 0
    for at in range(1, len(values)):
        while length and values[at] != values[length]:
            length = borders[length - 1]
        length += values[at] == values[length]
        borders[at] = length
    return borders
