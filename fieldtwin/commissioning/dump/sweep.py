"""Explore a whole register table with few reads: the readable addresses, the holes, and the longest read.

A sweep is a generator without I/O that yields questions (the ranges to read) and receives their outcomes. The same answers
always lead to the same questions. This is how an interrupted dump continues: recorded answers are replayed, and no question
is sent twice.

A read that is refused contains a hole (addresses that cannot be read) or is too long, and the exception code does not show
which (devices disagree). Therefore a single register is read next. If it is readable, the sweep reads on from there to the
next refusal, and a short read across that border shows its cause. In an area that cannot be read only some addresses are
tried (`Sweep.stride`). Where the device is silent `asking` stops early, because each request costs a timeout; `beyond`
continues from there within a time budget.
"""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass, field
from itertools import pairwise

from fieldtwin.commissioning.dump.coverage import INVALID, READABLE, REFUSED, SILENT, Coverage, joined
from fieldtwin.gateway.core.files.profile import RegisterRange, Table
from fieldtwin.gateway.protocols.modbus.requests.data import MAX_READ_BITS, MAX_READ_REGISTERS

ILLEGAL_FUNCTION = 0x01
DENSE = 8
"""Number of addresses after a readable one that a sweep tries one by one, before it begins to skip addresses."""
ROUND = 50
"""A sweep that skips addresses also tries multiples of this number, because blocks of registers often begin at round numbers."""
MOST_SILENT = 10
"""Number of consecutive reads without a reply after which a sweep stops trying single addresses."""
TRUSTED_SILENCE = 2
"""After this many repeated requests without a reply, further silence is trusted: probes of single addresses are not repeated."""
MOST_PAIR_TRIALS = 4


@dataclass(frozen=True, slots=True)
class Taken:
    """A read that the device answered with values. `raw` is as on the bus, for bits one byte each. `us` is the time in
    microseconds from the question to the end of its answer or timeout, in this and the other outcomes.
    """

    raw: bytes
    us: int = 0


@dataclass(frozen=True, slots=True)
class RefusedRead:
    """A read that the device refused, with the exception that it answered."""

    code: int
    us: int = 0


@dataclass(frozen=True, slots=True)
class Silent:
    """A read without a reply, despite all repetitions."""

    problem: str
    us: int = 0


@dataclass(frozen=True, slots=True)
class Invalid:
    """A reply that is not valid. `values` is its number of registers if only its size is wrong, else 0."""

    problem: str
    us: int = 0
    values: int = 0


Outcome = Taken | RefusedRead | Silent | Invalid
Asking = Generator[RegisterRange, Outcome, None]
Trying = Generator[RegisterRange, Outcome, bool]


@dataclass
class TableMap:
    """The properties of a table that single addresses do not show. Intervals are [start, end).

    A border is an address that a read may not cross although both sides can be read. In ``(start, end, n)`` of `units` reads take
    multiples of `n` registers from `start` on. `max_read` is the longest accepted read; `limit_proved` means that one more
    register is refused (or that it is the standard's limit). `grain` 2: the device accepts only pairs of registers. `codes`
    counts exceptions by code. `stopped` is the reason why the sweep did not ask all its questions; `function_refused` means that
    the device does not know the table's function. `lengths` are the read lengths that were tried wherever the sweep looked for
    registers among refusals.
    """

    table: Table
    readable: list[tuple[int, int]] = field(default_factory=list)
    borders: list[int] = field(default_factory=list)
    units: list[tuple[int, int, int]] = field(default_factory=list)
    max_read: int = 0
    limit_proved: bool = False
    grain: int = 1
    codes: dict[int, int] = field(default_factory=dict)
    stopped: str = ""
    function_refused: bool = False
    lengths: list[int] = field(default_factory=list)

    @property
    def cells(self) -> int:
        """Return the number of readable addresses."""
        return sum(end - start for start, end in self.readable)

    def add_unit(self, start: int, end: int, size: int) -> None:
        """Record that reads from `start` to before `end` must have a multiple of `size` registers."""
        self.units = [u for u in self.units if not (start <= u[0] and u[1] <= end)] + [(start, end, size)]

    def reads(self) -> list[RegisterRange]:
        """Return the fewest reads that cover all readable addresses and cross no hole and no border."""
        most = self.max_read or 1
        planned: list[RegisterRange] = []
        for start, end in self.readable:
            inside = {edge for low, high, _ in self.units for edge in (low, high) if start < edge < end}
            cuts = [start, *sorted({*inside, *(b for b in self.borders if start < b < end)}), end]
            for low, high in pairwise(cuts):
                unit = next((n for first, last, n in self.units if first <= low < last), 1)
                step = max(unit, most - most % unit)
                planned += [RegisterRange(self.table, a, min(step, high - a)) for a in range(low, high, step)]
        return planned


class Sweep:
    """An exploration of `span`. `most` is the longest read to try (None: the standard's limit). `stride` is the distance of the
    addresses that are tried in an area that cannot be read; 1 tries every address.

    `found` and `coverage` are filled while `asking` runs. `patient` is true if the last yielded question is to be repeated when
    no reply arrives. `budget_us` limits the time that requests without a result take (None: no limit); `spacing_us` is the pause
    after each.
    """

    def __init__(
        self,
        span: RegisterRange,
        *,
        most: int | None = None,
        stride: int = 8,
        grain: int = 1,
        budget_us: int | None = None,
        spacing_us: int = 0,
    ) -> None:
        bits = span.table in ("coil", "discrete")
        self.span = span
        self.stride = stride
        self.coverage = Coverage()
        self.asked: set[tuple[int, int]] = set()
        self.patient = True
        self.most_silent = MOST_SILENT
        self.charges_everything = False
        self.spent_us = 0
        self._budget_us, self._spacing_us = budget_us, spacing_us
        self._lost = False
        self._silences = 0
        self._hint = (-1, 0)
        self.found = TableMap(span.table, grain=grain)
        self.standard = MAX_READ_BITS if bits else MAX_READ_REGISTERS
        self._most = min(most or self.standard, self.standard)
        self._most -= self._most % grain
        self._silent = 0
        self.in_words = not bits
        self.singles = False
        self._pair_trials = MOST_PAIR_TRIALS if not bits and grain == 1 else 0

    @property
    def halted(self) -> bool:
        """Return whether the sweep must stop asking here, because it was stopped or the device has become silent."""
        return bool(self.found.stopped) or self._lost

    def asking(self) -> Asking:
        """Yield ranges to read, receive outcomes, and end when the span is known, the device silent, or the sweep stopped."""
        yield from self.walk(self.span.address)

    def resume(self) -> None:
        """Reset the count of unanswered reads, because the device has answered again."""
        self._lost, self._silent = False, 0

    def walk(self, at: int) -> Asking:
        """Read from `at` on until the span ends or the device is silent.

        Addresses known to be readable are not read again.
        """
        self.resume()
        end, begins = self.span.end, at
        while at < end and not self.halted:
            if self.coverage.states[at] == READABLE and at != begins:
                at += 1
                continue
            count = min(self._most, end - at)
            if (yield from self.ask(at, count)):
                at += count
                continue
            if self.halted:
                break
            at = begins = yield from self._after_a_refusal(at, count)

    def _after_a_refusal(self, at: int, count: int) -> Generator[RegisterRange, Outcome, int]:
        """Return the address at which to continue after a failed read of `count` cells at `at`.

        The method finds the readable beginning of that range, and the reason for its end.
        """
        grain = self.found.grain
        good = grain if count > grain and (yield from self.ask(at, grain)) else 0
        if not good and (unit := (yield from self.ask_the_length_that_came(at))):
            return at + unit
        if not good and count > 2 and (at in self.found.borders or (self._pair_trials and at % 2 == 0)):
            self._pair_trials -= 1
            if (yield from self.ask(at, 2)):
                good = 2
                if not self.singles:  # the device only accepts reads of register pairs
                    self.found.grain = grain = 2
                    self._most -= self._most % 2
        if not good:
            return (yield from self.through_a_void(at + grain))
        self._pair_trials = 0
        good = yield from self._longest(at, good, count, forward=True)
        return (yield from self._why_it_ends(at, good))

    def ask_the_length_that_came(self, at: int) -> Generator[RegisterRange, Outcome, int]:
        """If the last reply for `at` carried an unexpected number of registers, read that number.

        Return that number if the device answers with values, else 0.
        """
        (place, count), self._hint = self._hint, (-1, 0)
        if place != at or not count or (at, count) in self.asked or at + count > self.span.end:
            return 0
        if not (yield from self.ask(at, count)):
            return 0
        self.found.add_unit(at, at + count, count)
        self.found.borders += [at, at + count]
        return count

    def _longest(self, at: int, good: int, bad: int, *, forward: bool) -> Generator[RegisterRange, Outcome, int]:
        """Return the longest accepted read that begins (`forward`) or ends at `at`, between an accepted and a refused length."""
        grain = self.found.grain
        while bad - good > grain:
            middle = good + max(grain, (bad - good) // 2 // 2 * 2)
            if (yield from self.ask(at if forward else at - middle, middle)):
                good = middle
            else:
                bad = middle
        return good

    def _why_it_ends(self, at: int, good: int) -> Generator[RegisterRange, Outcome, int]:
        """Find why a read of `good` cells from `at` is accepted and a longer one is not: a hole, a border, or the limit.

        Return the address at which to continue.
        """
        grain, edge = self.found.grain, at + good
        if edge + grain > self.span.end or self.halted:
            return edge
        if not (yield from self.ask(edge, grain)):
            if unit := (yield from self.ask_the_length_that_came(edge)):
                return edge + unit
            if grain == 1 and self.in_words and edge + 2 <= self.span.end and (yield from self.ask(edge, 2)):
                self.found.borders.append(edge)  # two registers form one value, which a read must not cut
                return edge
            return (yield from self.through_a_void(edge + grain))
        if good > grain and not (yield from self.ask(edge - grain, 2 * grain)):
            self.found.borders.append(edge)
            return edge
        self._most = good
        self.found.limit_proved = True
        return edge

    def through_a_void(self, at: int) -> Generator[RegisterRange, Outcome, int]:
        """Return the address at which to continue after an address that could not be read: the next readable block, or the span's
        end.

        `at` is the first address that was not tried yet.
        """
        end, grain, dense = self.span.end, self.found.grain, at + DENSE
        unasked = probe = at  # the addresses between these two were not read
        while probe < end and not self.halted:
            if (yield from self._probe(probe, strided=probe >= dense and self.stride > 1)):
                return (yield from self.back_from(probe, unasked))
            if unit := (yield from self.ask_the_length_that_came(probe)):
                return probe + unit
            unasked = min(probe + grain, end)
            probe = self._next_probe(probe, dense)
        return end

    def back_from(self, at: int, lowest: int) -> Generator[RegisterRange, Outcome, int]:
        """Return where the block of the readable register at `at` begins, at `lowest` or after it."""
        grain = self.found.grain
        while at > lowest and not self.halted:
            room = min(at - lowest, self._most)
            room -= room % grain
            if not room:
                break
            if (yield from self.ask(at - room, room)):
                at -= room
                continue
            back = yield from self._longest(at, 0, room, forward=False)
            at -= back
            if not back or at - grain < lowest or not (yield from self.ask(at - grain, grain)):
                break
        return at

    def _probe(self, at: int, *, strided: bool) -> Trying:
        """Read at `at`, unless this was done before, and return whether the address can be read.

        As long as no single register was readable, the device may permit only reads of two registers. Therefore a pair of
        registers is also read, and it is read first if the sweep does not try every address (`strided`).
        """
        grain = self.found.grain
        readable = self.coverage.states[at] == READABLE
        if readable or (at, grain) in self.asked or at + grain > self.span.end:
            return readable
        self.patient = self._silences < TRUSTED_SILENCE
        if self.singles or grain == 2 or not self.in_words or at % 2 or at + 2 > self.span.end:
            return (yield from self.ask(at, grain))
        if strided and not (yield from self.ask(at, 2)):
            return False
        if (yield from self.ask(at, 1)):
            return True
        if strided or (yield from self.ask(at, 2)):
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

    def ask(self, address: int, count: int) -> Trying:
        """Read `count` cells from `address` and record the outcome. Return whether the device returned their values."""
        if self.found.stopped:
            return False
        self.asked.add((address, count))
        at = RegisterRange(self.span.table, address, count)
        outcome = yield at
        patient, self.patient = self.patient, True
        found = self.found
        if isinstance(outcome, Taken):
            self._silent = 0
            self.singles |= count == 1
            self.coverage.note(at, READABLE)
            self._add(found.readable, address, address + count)
            found.max_read = max(found.max_read, count)
            found.limit_proved |= count == self.standard
        elif isinstance(outcome, RefusedRead):
            self._silent = 0
            self.coverage.note(at, REFUSED)
            found.codes[outcome.code] = found.codes.get(outcome.code, 0) + 1
            if found.codes.get(ILLEGAL_FUNCTION, 0) >= 2 and not found.readable:
                found.function_refused = True
                found.stopped = "the device refuses the function of this table (exception 01)"
        elif isinstance(outcome, Invalid):
            self._silent = 0
            self.coverage.note(at, INVALID)
            self._hint = (address, outcome.values if outcome.values != count else 0)
        else:
            self._silent += 1
            self._silences += patient
            self.coverage.note(at, SILENT)
            self._lost |= self._silent >= self.most_silent
        self._charge(outcome)
        return isinstance(outcome, Taken)

    def _charge(self, outcome: Outcome) -> None:
        """Count the time of a request without a result against the budget."""
        if self.charges_everything or isinstance(outcome, Silent | Invalid):
            self.spent_us += outcome.us + self._spacing_us
        if self._budget_us is not None and self.spent_us > self._budget_us and not self.found.stopped:
            self.found.stopped = (
                f"the time budget of {self._budget_us / 1e6:g} s for requests without a result is used up"
            )

    @staticmethod
    def _add(spans: list[tuple[int, int]], start: int, end: int) -> None:
        """Add the interval [start, end) to `spans`.

        Nearly always it follows or touches the last interval; otherwise the intervals are sorted and joined.
        """
        if not spans or spans[-1][1] < start:
            spans.append((start, end))
        elif spans[-1][0] <= start:
            spans[-1] = (spans[-1][0], max(spans[-1][1], end))
        else:
            spans[:] = joined([*spans, (start, end)])
