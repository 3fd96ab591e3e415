"""What was written before: the part of a device's past on which its recorded answers depend (SPEC ruling 3).

A situation is the last value written to each cell, of one unit, since the recording began. Each has a number. What was
recorded is kept by situation; what is asked for is looked up in the present situation or, where nothing was recorded in that one,
in the recorded one that is most like it. Pure bookkeeping; it knows no protocol.
"""

from __future__ import annotations

from collections.abc import Sequence

from fieldtwin.emulators.modbus.bank import Table
from fieldtwin.gateway.core.errors import Bug

Cell = tuple[Table, int]
Written = tuple[Cell, int]

MAX_SITUATIONS = 1024
"""Distinct situations of one unit that are told apart; further ones are kept with the last of these, counted as `folded`."""


class Situations:
    """Numbers the recorded situations of one unit and follows its writes. Number 0: nothing was written.

    First the recording is learned, then `rewind` goes back to its beginning: from there on nothing more is learned, so that
    a master that writes ever new values costs no memory.
    """

    def __init__(self, max_situations: int = MAX_SITUATIONS) -> None:
        self.max_situations = max_situations
        self.folded = 0
        self.now: int | None = 0
        """The present situation's number; None for one that was never recorded."""
        self._learning = True
        self._state: dict[Cell, Written] = {}
        self._known: list[frozenset[Written]] = [frozenset()]
        self._values: list[dict[Cell, int]] = [{}]
        self._numbers: dict[frozenset[Written], int] = {frozenset(): 0}

    def copy(self) -> Situations:
        """Another unit of the same recording, of which nothing more is learned: it begins at the beginning."""
        if self._learning:
            raise Bug("situations were copied while they are being learned")
        other = Situations(self.max_situations)
        other.folded, other._learning = self.folded, False
        other._known, other._values, other._numbers = self._known, self._values, self._numbers
        return other

    @property
    def learned(self) -> int:
        """The number under which what is being recorded now is kept."""
        return len(self._known) - 1 if self.now is None else self.now

    def rewind(self) -> None:
        """Nothing was written yet; what is known stays known, and no more is learned."""
        self._learning = False
        self._state = {}
        self.now = 0

    def write(self, table: Table, address: int, values: Sequence[int]) -> None:
        """The unit accepted these values for the cells from `address` on."""
        for i, value in enumerate(values):
            cell = (table, address + i)
            self._state[cell] = (cell, value)
        state = frozenset(self._state.values())
        self.now = self._numbers.get(state)
        if self.now is None and self._learning:
            self._learn(state)

    def _learn(self, state: frozenset[Written]) -> None:
        if len(self._known) >= self.max_situations:
            self.folded += 1
            return
        self.now = self._numbers[state] = len(self._known)
        self._known.append(state)
        self._values.append(dict(state))

    def written(self, cell: Cell) -> int | None:
        """The value last written to `cell`, or None."""
        written = self._state.get(cell)
        return written[1] if written else None

    def written_in(self, situation: int, cell: Cell) -> int | None:
        """The value that `cell` had last been given in that situation, or None."""
        return self._values[situation].get(cell)

    def most_alike(self, candidates: Sequence[int]) -> int:
        """Of some situations the one most like the present one; the earliest of several.

        Most alike: most cells with the same value, then most cells written at all, then fewest written besides.
        """
        if self.now is not None and self.now in candidates:
            return self.now
        present = frozenset(self._state.values())

        def likeness(situation: int) -> tuple[int, int, int]:
            other = self._values[situation]
            return len(present & self._known[situation]), sum(cell in self._state for cell in other), -len(other)

        return max(candidates, key=likeness)
