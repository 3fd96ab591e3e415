"""The state of each address of a Modbus table in a dump: readable, refused, silent, invalid reply, or not asked.

The states are derived from the recorded reads alone, so that the terminal, the file, the reports and `diff` cannot disagree.
An address is readable if any read that contains it was answered with values. Otherwise the shortest read that contains it
decides, and only if that read is short: the refusal of 125 registers does not show which of them is refused.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from fieldtwin.gateway.core.files.profile import RegisterRange, Table, gap_text

NOT_ASKED, READABLE, REFUSED, SILENT, INVALID = range(5)
STATE_NAMES = ("not asked", "readable", "refused", "no reply", "invalid reply")
"""The names of the states for users; the keys of a dump file are `STATE_KEYS`."""
STATE_KEYS = ("not_asked", "readable", "refused", "silent", "invalid")
SHORT = 2
"""A refused read of more values than this does not show the state of a single address."""
GRID = 8
"""A range of fewer addresses than this between two definite answers counts as sampled and not as unknown."""
ADDRESSES = 65536

Spans = Sequence[tuple[int, int]]
"""Half-open intervals of addresses, in order."""


class Coverage:
    """The states of the addresses of one table. A failed read decides their states only if it has at most `longest_deciding`
    values.
    """

    def __init__(self, longest_deciding: int = SHORT) -> None:
        self.states = bytearray(ADDRESSES)
        self._longest = longest_deciding
        self._sizes = bytearray(ADDRESSES)

    def note(self, at: RegisterRange, state: int) -> None:
        """Record the outcome of a read of `at`: one of `READABLE`, `REFUSED`, `SILENT`, `INVALID`."""
        if state == READABLE:
            self.states[at.address : at.end] = bytes((READABLE,)) * at.count
            return
        if at.count > self._longest:
            return
        size = min(at.count, 255)
        for address in range(at.address, at.end):
            known = self.states[address]
            if known == NOT_ASKED or (known != READABLE and size <= self._sizes[address]):
                self.states[address], self._sizes[address] = state, size

    def is_definite(self, address: int) -> bool:
        """Return whether the device accepted or refused this address."""
        return self.states[address] in (READABLE, REFUSED)

    def is_sampled(self, address: int) -> bool:
        """Return whether there are definite answers within `GRID` addresses on both sides, or at the address."""
        below = self.states[max(0, address - GRID + 1) : address + 1]
        above = self.states[address : address + GRID]
        return any(s in (READABLE, REFUSED) for s in below) and any(s in (READABLE, REFUSED) for s in above)

    def runs(self, scope: Spans) -> Iterator[tuple[int, int, int]]:
        """Yield ``(start, end, state)`` of neighbouring addresses in one state."""
        for low, high in scope:
            start = low
            for address in range(low + 1, high + 1):
                if address == high or self.states[address] != self.states[start]:
                    yield start, address, self.states[start]
                    start = address

    def unknown(self, scope: Spans) -> list[tuple[int, int]]:
        """Return the ranges without a definite answer that have at least `GRID` addresses or fill a whole, smaller range of
        `scope`.
        """
        found: list[tuple[int, int]] = []
        for low, high in scope:
            start = low
            for first, end, state in self.runs([(low, high)]):
                if state in (READABLE, REFUSED):
                    if first - start >= GRID:
                        found.append((start, first))
                    start = end
            if high - start >= min(GRID, high - low):
                found.append((start, high))
        return found

    def count(self, state: int, scope: Spans) -> int:
        """Return the number of addresses of `scope` in `state`."""
        return sum(self.states.count(state, low, high) for low, high in scope)


@dataclass(frozen=True, slots=True)
class Stretch:
    """A range of addresses from `start` to before `end`, of which `asked` were requested, all with the outcome `state`."""

    start: int
    end: int
    asked: int
    state: int

    @property
    def is_whole(self) -> bool:
        return self.asked == self.end - self.start


def stretches(coverage: Coverage, scope: Spans) -> list[Stretch]:
    """Return the states of `scope`, in order. Scattered samples with the same outcome become one stretch."""
    found: list[Stretch] = []
    gap: tuple[int, int] | None = None
    for low, high in scope:
        fresh = len(found)
        for start, end, state in coverage.runs([(low, high)]):
            if state == NOT_ASKED:
                gap = (start, end)
                continue
            one = Stretch(start, end, end - start, state)
            last = found[-1] if len(found) > fresh else None
            joins = gap is not None and last is not None and last.state == state != READABLE
            if joins and last is not None and max(end - start, _tail(last)) < GRID:
                found[-1] = Stretch(last.start, end, last.asked + one.asked, state)
            else:
                if gap is not None:
                    found.append(Stretch(*gap, 0, NOT_ASKED))
                found.append(one)
            gap = None
        if gap is not None:
            found.append(Stretch(*gap, 0, NOT_ASKED))
        gap = None
    return found


def _tail(stretch: Stretch) -> int:
    """Return the number of addresses of a stretch if all of them were requested; else 0, because more samples may join it."""
    return stretch.asked if stretch.is_whole else 0


def describe(table: Table, coverage: Coverage, scope: Spans, *, function_refused: bool = False) -> dict[str, Any]:
    """Return the states of a table in the form of a dump file and of the JSON output.

    The lists hold ranges in which every address has that state. `sampled` holds ranges in which only some addresses
    were read. `unknown` is empty where the device refused the whole function, which is a definite answer.
    """

    def text(low: int, high: int) -> str:
        return gap_text(RegisterRange(table, low, high - low))

    out: dict[str, Any] = {"scope": [text(a, b) for a, b in scope]}
    parts = stretches(coverage, scope)
    for state in (READABLE, REFUSED, SILENT, INVALID, NOT_ASKED):
        whole = [p for p in parts if p.state == state and (p.is_whole or state == NOT_ASKED)]
        out[STATE_KEYS[state]] = [text(p.start, p.end) for p in whole]
    out["sampled"] = [
        {"range": text(p.start, p.end), "state": STATE_KEYS[p.state], "asked": p.asked, "addresses": p.end - p.start}
        for p in parts
        if p.state != NOT_ASKED and not p.is_whole
    ]
    unknown = [] if function_refused else coverage.unknown(scope)
    out["unknown"] = [text(a, b) for a, b in unknown]
    out["counts"] = {STATE_KEYS[s]: coverage.count(s, scope) for s in (READABLE, REFUSED, SILENT, INVALID, NOT_ASKED)}
    out["counts"]["unknown"] = sum(b - a for a, b in unknown)
    return out


def joined(spans: Iterable[tuple[int, int]]) -> list[tuple[int, int]]:
    """Return the intervals in order; those that touch or overlap are joined."""
    out: list[tuple[int, int]] = []
    for start, end in sorted(spans):
        if out and out[-1][1] >= start:
            out[-1] = (out[-1][0], max(out[-1][1], end))
        else:
            out.append((start, end))
    return out


def coarse_to_fine(start: int, end: int, finest: int, levels: Sequence[Sequence[int]]) -> Iterator[int]:
    """Yield each multiple of `finest` or of a number in `levels` from `start` to before `end`, round numbers first."""
    seen: set[int] = set()
    yield start
    seen.add(start)
    for steps in (*levels, (finest,)):
        for address in sorted({a for step in steps for a in range(start + -start % step, end, step)} - seen):
            seen.add(address)
            yield address
