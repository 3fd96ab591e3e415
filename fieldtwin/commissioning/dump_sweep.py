"""How a whole register table is found out with few reads: what can be read, where the holes are, how long a read may be.

Pure: a sweep is a generator that yields what to ask and is sent what came of it. The same answers always lead to the same
questions, which is how an interrupted dump goes on: what was recorded is answered again, and nothing is asked twice.

A read that is refused has a hole in it or is too long, and the exception code does not tell which (devices disagree). So a
single register decides; behind a readable prefix the next register decides again, and a short read over the border.
In a void only some addresses are asked (`Sweep.stride`): what is readable for at least that long is always found.
"""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass, field
from itertools import pairwise

from gateway.core.profile import RegisterRange, Table
from gateway.protocols.modbus.requests import MAX_READ_BITS, MAX_READ_REGISTERS

ILLEGAL_FUNCTION = 0x01
DENSE = 8
"""So many addresses behind a readable one are all asked before a sweep strides."""
ROUND = 50
"""A stride also stops at round numbers, as manuals like them."""
MOST_SILENT = 10
"""After so many reads in a row without a reply a table is given up."""
MOST_PAIR_TRIALS = 4


@dataclass(frozen=True, slots=True)
class Taken:
    """The device answered; `raw` as on the wire, bits one a byte."""

    raw: bytes


@dataclass(frozen=True, slots=True)
class Refused:
    """The device answered with this exception."""

    code: int


@dataclass(frozen=True, slots=True)
class Silent:
    """No good reply, however often it was asked."""

    problem: str


Outcome = Taken | Refused | Silent
Asking = Generator[RegisterRange, Outcome, None]
Trying = Generator[RegisterRange, Outcome, bool]


@dataclass
class TableMap:
    """What was found out about a table. Intervals are [start, end) in the order of addresses.

    `holes` were asked one by one and refused; in `voids` every address that was asked was refused, and not all were asked.
    A border, at its address, is where a read may not go over although both sides can be read. `max_read` is the longest
    read that was taken; `limit_proved` says that one more is refused (or that it is the standard's limit). `codes`
    counts exceptions. `given_up` says why nothing more was asked.
    """

    table: Table
    readable: list[tuple[int, int]] = field(default_factory=list)
    holes: list[tuple[int, int]] = field(default_factory=list)
    voids: list[tuple[int, int]] = field(default_factory=list)
    borders: list[int] = field(default_factory=list)
    max_read: int = 0
    limit_proved: bool = False
    grain: int = 1
    codes: dict[int, int] = field(default_factory=dict)
    given_up: str = ""

    @property
    def cells(self) -> int:
        """How many addresses can be read."""
        return sum(end - start for start, end in self.readable)

    def reads(self) -> list[RegisterRange]:
        """The fewest reads that bring everything readable, never over a hole or a border."""
        most = self.max_read or 1
        planned = []
        for start, end in self.readable:
            cuts = [start, *(b for b in self.borders if start < b < end), end]
            for low, high in pairwise(cuts):
                planned += [RegisterRange(self.table, a, min(most, high - a)) for a in range(low, high, most)]
        return planned


class Sweep:
    """Finds out about `span`. `most` is the longest read to try (None: the standard's). `stride` 1 asks every address.

    `found` grows as `asking` runs.
    """

    def __init__(self, span: RegisterRange, *, most: int | None = None, stride: int = 8, grain: int = 1) -> None:
        bits = span.table in ("coil", "discrete")
        self.span = span
        self.stride = stride
        self.found = TableMap(span.table, grain=grain)
        self._standard = MAX_READ_BITS if bits else MAX_READ_REGISTERS
        self._most = min(most or self._standard, self._standard)
        self._most -= self._most % grain
        self._silent = 0
        self._in_words = not bits
        self._singles = False
        self._pair_trials = MOST_PAIR_TRIALS if not bits and grain == 1 else 0

    def asking(self) -> Asking:
        """Yields ranges to read, is sent outcomes, and ends when the span is known or the table given up."""
        at, end = self.span.address, self.span.end
        while at < end and not self.found.given_up:
            if (yield from self._try(at, min(self._most, end - at))):
                at += min(self._most, end - at)
                continue
            if self.found.given_up:
                break
            at = yield from self._behind_a_refusal(at, min(self._most, end - at))
        self._settle()

    def _behind_a_refusal(self, at: int, count: int) -> Generator[RegisterRange, Outcome, int]:
        """`count` cells from `at` were refused: where to go on. Finds the readable prefix, and why it ends."""
        grain = self.found.grain
        good = grain if count > grain and (yield from self._try(at, grain)) else 0
        if not good and count > 2 and (at in self.found.borders or (self._pair_trials and at % 2 == 0)):
            self._pair_trials -= 1
            if (yield from self._try(at, 2)):
                good = 2
                if not self._singles:  # a device that knows pairs only
                    self.found.grain = grain = 2
                    self._most -= self._most % 2
        if not good:
            self._add(self.found.holes, at, min(at + grain, self.span.end))
            return (yield from self._through_a_void(at, at + grain))
        self._pair_trials = 0
        good = yield from self._longest(at, good, count, forward=True)
        return (yield from self._why_it_ends(at, good))

    def _longest(self, at: int, good: int, bad: int, *, forward: bool) -> Generator[RegisterRange, Outcome, int]:
        """The longest read that is taken, from `at` on or up to it, between one that is and one that is not."""
        grain = self.found.grain
        while bad - good > grain:
            middle = good + max(grain, (bad - good) // 2 // 2 * 2)
            if (yield from self._try(at if forward else at - middle, middle)):
                good = middle
            else:
                bad = middle
        return good

    def _why_it_ends(self, at: int, good: int) -> Generator[RegisterRange, Outcome, int]:
        """A read of `good` cells from `at` is taken and a longer one is not: a hole behind it, a border, or the limit?"""
        grain, edge = self.found.grain, at + good
        if edge + grain > self.span.end:
            return edge
        if not (yield from self._try(edge, grain)):
            if grain == 1 and self._in_words and edge + 2 <= self.span.end and (yield from self._try(edge, 2)):
                self.found.borders.append(edge)  # a value of two registers that may not be cut
                return edge
            self._add(self.found.holes, edge, min(edge + grain, self.span.end))
            return (yield from self._through_a_void(at, edge + grain))
        if good > grain and not (yield from self._try(edge - grain, 2 * grain)):
            self.found.borders.append(edge)
            return edge
        self._most = good
        self.found.limit_proved = True
        return edge

    def _through_a_void(self, readable: int, at: int) -> Generator[RegisterRange, Outcome, int]:
        """From `at`, just behind something refused, to the next address that can be read, or to the end."""
        end, grain, dense = self.span.end, self.found.grain, at + DENSE
        refused = at  # everything from here to the next probe is unknown
        probe = at
        while probe < end and not self.found.given_up:
            if not (yield from self._probe(probe, strided=probe >= dense and self.stride > 1)):
                self._refused_at(refused, probe, min(probe + grain, end))
                refused = min(probe + grain, end)
                probe = self._next_probe(probe, dense)
                continue
            grain, back = self.found.grain, 0
            if probe > refused:  # it may begin before the probe
                room = probe - refused
                back = room
                if not (yield from self._try(refused, room)):
                    back = yield from self._longest(probe, 0, room, forward=False)
                self._refused_at(refused, probe - back, probe - back)
            return probe - back
        if refused < end:
            self._add(self.found.voids, refused, end)
        return end

    def _probe(self, at: int, *, strided: bool) -> Trying:
        """Whether something can be read at `at`. As long as nothing could be, the device may know pairs only: a pair is asked
        for too, and where not every address is asked, first."""
        grain = self.found.grain
        if at + grain > self.span.end:
            return False
        if self._singles or grain == 2 or not self._in_words or at % 2 or at + 2 > self.span.end:
            return (yield from self._try(at, grain))
        if strided and not (yield from self._try(at, 2)):
            return False
        if (yield from self._try(at, 1)):
            return True
        if strided or (yield from self._try(at, 2)):
            self.found.grain = 2
            self._most -= self._most % 2
            return True
        return False

    def _next_probe(self, probe: int, dense: int) -> int:
        grain = self.found.grain
        if self.stride <= grain or probe + grain < dense:
            return probe + grain
        after = probe + 1
        jump = min(after + -after % self.stride, after + -after % ROUND)
        return max(jump + -jump % grain, probe + grain)

    def _refused_at(self, unknown: int, probe: int, end: int) -> None:
        """`probe` to `end` was refused by itself; before it, from `unknown` on, nothing was asked."""
        if unknown < probe:
            self._add(self.found.voids, unknown, probe)
        if probe < end:
            self._add(self.found.holes, probe, end)

    def _try(self, address: int, count: int) -> Trying:
        outcome = yield RegisterRange(self.span.table, address, count)
        found = self.found
        if isinstance(outcome, Taken):
            self._silent = 0
            self._singles |= count == 1
            self._add(found.readable, address, address + count)
            found.max_read = max(found.max_read, count)
            found.limit_proved |= count == self._standard
            return True
        if isinstance(outcome, Refused):
            self._silent = 0
            found.codes[outcome.code] = found.codes.get(outcome.code, 0) + 1
            if outcome.code == ILLEGAL_FUNCTION and not found.readable:
                found.given_up = "the device has no such function"
        else:
            self._silent += 1
            if self._silent >= MOST_SILENT:
                found.given_up = f"no reply {MOST_SILENT} times in a row"
        return False

    @staticmethod
    def _add(spans: list[tuple[int, int]], start: int, end: int) -> None:
        """Put [start, end) in. Nearly always it goes up and touches the last one; what goes back is put in order."""
        if not spans or spans[-1][1] < start:
            spans.append((start, end))
        elif spans[-1][0] <= start:
            spans[-1] = (spans[-1][0], max(spans[-1][1], end))
        else:
            spans[:] = joined([*spans, (start, end)])

    def _settle(self) -> None:
        """What was asked here and there inside a void is part of it: of both the same is known, that nothing answered."""
        found = self.found
        edges = {s for s, _ in found.voids} | {e for _, e in found.voids}
        probes = [h for h in found.holes if h[1] - h[0] < DENSE and (h[0] in edges or h[1] in edges)]
        found.holes = [h for h in found.holes if h not in probes]
        found.voids = joined(found.voids + probes)


def joined(spans: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """Intervals in order, those that touch or overlap made one."""
    out: list[tuple[int, int]] = []
    for start, end in sorted(spans):
        if out and out[-1][1] >= start:
            out[-1] = (out[-1][0], max(out[-1][1], end))
        else:
            out.append((start, end))
    return out
