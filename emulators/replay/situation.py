"""The situation of a device: its past writes, on which its recorded answers depend (docs/explanation/paper.md, ruling 3).

A situation is the last value written to each cell of one unit since the recording began. Each situation has a number.
Recordings are kept by situation. A read uses the present situation or, if nothing was recorded in it, the most similar
recorded one. This module performs no I/O and does not depend on a protocol.
"""

from __future__ import annotations

from collections.abc import Sequence

from fieldtwin.emulators.modbus.bank import Table
from fieldtwin.gateway.core.errors import Bug

Cell = tuple[Table, int]
Written = tuple[Cell, int]

MAX_SITUATIONS = 1024
"""The number of situations of one unit that are distinguished. Further situations are treated as the last of these, and
counted as `folded`.
"""


class Situations:
    """The numbered situations of one unit, which follow its writes. In situation 0 nothing was written.

    After the recording has been learned, `rewind` returns to its beginning. From then on nothing more is learned, so
    that a client that always writes new values needs no memory.
    """

    def __init__(self, max_situations: int = MAX_SITUATIONS) -> None:
        self.max_situations = max_situations
        self.folded = 0
        self.now: int | None = 0
        """The present situation's number; None if it was not recorded."""
        self._learning = True
        self._state: dict[Cell, Written] = {}
        self._known: list[frozenset[Written]] = [frozenset()]
        self._values: list[dict[Cell, int]] = [{}]
        self._numbers: dict[frozenset[Written], int] = {frozenset(): 0}

    def copy(self) -> Situations:
        """Return the situations for a second unit of the same recording, in the initial state and without further learning."""
        if self._learning:
            raise Bug("situations were copied while they are being learned")
        other = Situations(self.max_situations)
        other.folded, other._learning = self.folded, False
        other._known, other._values, other._numbers = self._known, self._values, self._numbers
        return other

    @property
    def learned(self) -> int:
        """Return the number under which the present recording is kept."""
        return len(self._known) - 1 if self.now is None else self.now

    def rewind(self) -> None:
        """Return to the initial state without writes. The learned situations are kept; no further ones are learned."""
        self._learning = False
        self._state = {}
        self.now = 0

    def write(self, table: Table, address: int, values: Sequence[int]) -> None:
        """Record that the unit accepted these values for the cells from `address` on."""
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
        """Return the value last written to `cell`, or None."""
        written = self._state.get(cell)
        return written[1] if written else None

    def written_in(self, situation: int, cell: Cell) -> int | None:
        """Return the value last written to `cell` in that situation, or None."""
        return self._values[situation].get(cell)

    def most_similar(self, candidates: Sequence[int]) -> int:
        """Return the candidate most similar to the present situation; the earliest if there are several.

        The most similar candidate has the most cells with the same value; among equals the most cells that are written at all,
        then the fewest additional writes.
        """
        if self.now is not None and self.now in candidates:
            return self.now
        present = frozenset(self._state.values())

        def likeness(situation: int) -> tuple[int, int, int]:
            other = self._values[situation]
            return len(present & self._known[situation]), sum(cell in self._state for cell in other), -len(other)

        return max(candidates, key=likeness)
