"""Recorded counters: values in several registers. The registers of a counter are always read from the same moment, and a
counter never decreases.

Registers of a counter that come from different moments form a number that never existed. A counter's registers therefore advance
together: a read gets the present value, and the counter advances to the next value only when a read contains a register that was
already read. So reading the counter as a whole or in parts gives the same numbers. Earlier writes do not affect a counter, and at
the end of its recording it keeps its value under every policy (docs/explanation/paper.md, ruling 3).
"""

from __future__ import annotations

import struct
from collections.abc import Iterable
from dataclasses import dataclass

from fieldtwin.emulators.context import EndOfRecording, Recorded, UsedUp, VirtualContext
from fieldtwin.emulators.modbus.bank import Table
from fieldtwin.emulators.replay.situation import Cell
from fieldtwin.gateway.core.errors import Bug, UnknownCommand
from fieldtwin.gateway.core.values import COMMAND, RECORDING


@dataclass(frozen=True, slots=True)
class CounterSpan:
    """A counter of the device profile: `count` registers of one unit from `address` on."""

    unit: int
    table: Table
    address: int
    count: int


class _Counter:
    """One counter. Its values are assembled from registers while the recording is learned. Later they are read register by
    register.
    """

    def __init__(self, span: CounterSpan) -> None:
        if not 1 <= span.count <= 4:
            raise Bug("registers of a counter", expected="1 to 4", got=str(span.count))
        self.span = span
        self.command = COMMAND(struct.pack(">BBH", span.unit, 0xFE, span.address) + span.table.encode())
        self.partial: dict[int, int] = {}
        self.shown: tuple[int, ...] | None = None
        self.seen: set[int] = set()


class RecordingCounters:
    """The counters of a recording. `torn` counts registers that were recorded without the rest of their counter."""

    def __init__(self, spans: Iterable[CounterSpan], context: VirtualContext) -> None:
        self._context = context
        self._by_cell: dict[tuple[int, Cell], tuple[_Counter, int]] = {}
        self.torn = 0
        for span in spans:
            counter = _Counter(span)
            for i in range(span.count):
                self._by_cell[span.unit, (span.table, span.address + i)] = (counter, i)

    def copy(self, context: VirtualContext) -> RecordingCounters:
        """Return the same counters on a copy of the context, in their initial state."""
        other = RecordingCounters((), context)
        other.torn = self.torn
        made: dict[int, _Counter] = {}
        for place, (counter, i) in self._by_cell.items():
            mine = made.setdefault(id(counter), _Counter(counter.span))
            other._by_cell[place] = (mine, i)
        return other

    def counts(self, unit: int, cell: Cell) -> bool:
        """Return whether the register belongs to a counter."""
        return (unit, cell) in self._by_cell

    def learn(self, unit: int, cell: Cell, value: int, t_s: float) -> bool:
        """Learn the recorded value of a register. Return whether the register belongs to a counter."""
        found = self._by_cell.get((unit, cell))
        if found is None:
            return False
        counter, i = found
        self.torn += i in counter.partial
        counter.partial[i] = value
        if len(counter.partial) == counter.span.count:
            words = struct.pack(f">{counter.span.count}H", *(counter.partial[k] for k in range(counter.span.count)))
            self._context.add(counter.command, Recorded(t_s, RECORDING(words)))
            self._context.set_policies({counter.command.data: EndOfRecording.HOLD})
            counter.partial.clear()
        return True

    def knows(self, unit: int, cell: Cell) -> bool:
        """Return whether the register belongs to a counter of which at least one whole value was recorded."""
        found = self._by_cell.get((unit, cell))
        return found is not None and (found[0].shown is not None or self._context.left(found[0].command) > 0)

    def begin(self, unit: int, table: Table, addresses: range) -> None:
        """Begin a request for these registers: a counter advances if a register that was already read is read again."""
        for address in addresses:
            counter, i = self._by_cell.get((unit, (table, address)), (None, 0))
            if counter is not None and (counter.shown is None or i in counter.seen):
                self._move_on(counter)

    def read(self, unit: int, cell: Cell) -> int:
        """Return the register's value. The caller must have called `knows`, and `begin` for the whole request."""
        counter, i = self._by_cell[unit, cell]
        if counter.shown is None:
            raise Bug("a counter was read before its request began")
        counter.seen.add(i)
        return counter.shown[i]

    def _move_on(self, counter: _Counter) -> None:
        try:
            words = self._context.take(counter.command).data
        except (UnknownCommand, UsedUp):
            return  # no whole value was recorded: `knows` reports that
        counter.shown = struct.unpack(f">{counter.span.count}H", words)
        counter.seen.clear()
