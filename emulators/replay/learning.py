"""Learn the behaviour of units from a recording: values that were read, writes and their effects, refusals, limits, latency.

A `Learner` processes the exchanges once. The result is a virtual context and a `LearntUnit` for each unit, from which `replay`
answers. The commands of the context are cells (single bits or registers) and shapes (function, address and count of a request).
This module performs no I/O.
"""

from __future__ import annotations

import copy
import struct
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

from fieldtwin.emulators.context import MAX_ENTRIES, Recorded, VirtualContext
from fieldtwin.emulators.modbus.bank import Table
from fieldtwin.emulators.modbus.functions.registers import STANDARD_FUNCTIONS
from fieldtwin.emulators.replay import requests
from fieldtwin.emulators.replay.columns import EXCHANGE_OVERHEAD_BYTES, CellValues, Merged, OutcomeColumn, Outcomes
from fieldtwin.emulators.replay.counters import RecordingCounters
from fieldtwin.emulators.replay.requests import CellRequest
from fieldtwin.emulators.replay.situation import Cell, Situations
from fieldtwin.gateway.core.files.recording import RecordedExchange
from fieldtwin.gateway.core.values import COMMAND, RECORDING

TABLE_CODES: dict[Table, int] = {"coil": 0, "discrete": 1, "holding": 3, "input": 4}
_SHAPE_CODE = 0xFF
CELL_KEY = 4
"""The number of bytes of a cell's key. The key of a shape is longer, or has a different second byte."""
MAX_BYTES = 512_000_000
"""Memory limit in bytes for the replies to recorded reads. If it is exceeded, the older half is dropped and counted."""


@dataclass(slots=True)
class ReplayCounters:
    """Counters of a replay. `misfits` counts recorded replies that do not fit their request; all other counters count answers."""

    answered: int = 0
    exceptions: int = 0
    silences: int = 0
    never_recorded: int = 0
    used_up: int = 0
    misfits: int = 0


class LearntUnit:
    """The properties of one unit that were learned from its recordings."""

    def __init__(self) -> None:
        self.situations = Situations()
        self.recorded_in: dict[bytes, list[int]] = {}  # cell or shape -> situations, in recorded order
        self.alike: dict[bytes, int] = {}  # cell or shape -> the situation to use now
        self.functions: set[int] = set()
        self.put: dict[Cell, int] = {}  # cells that the unit itself changed
        self.request_lengths: dict[int, set[int]] = {}  # non-standard function -> recorded lengths
        self.writable: set[Cell] = set()
        self.refused_writes: dict[tuple[int, int, int], Recorded] = {}
        self.most_read: dict[int, int] = {}  # function -> the largest number of cells that was ever answered
        # function -> the smallest number of cells that was ever refused with 03
        self.least_refused: dict[int, int] = {}
        self.latency: dict[int, tuple[int, float]] = {}  # function -> number of reads, and the sum of their latencies
        self.by_situation: dict[int, dict[bytes, OutcomeColumn]] = {0: {}}  # while learning
        self.columns = self.by_situation[0]  # the columns of the present situation
        self.addresses: dict[Table, list[int]] | None = (
            None  # recorded addresses, computed when a gap between them is read
        )

    def copy(self) -> LearntUnit:
        """Return a unit that shares the learned data, in its initial state."""
        other = copy.copy(self)
        other.situations, other.alike, other.put = self.situations.copy(), {}, {}
        return other

    def write(self, request: CellRequest, values: tuple[int, ...]) -> None:
        """Record a write that the unit accepted."""
        self.situations.write(request.table, request.address, values)
        self.alike.clear()
        if self.put:
            for address in request.addresses:
                self.put.pop((request.table, address), None)

    def usual_latency_s(self, function: int) -> float:
        count, total = self.latency.get(function, (0, 0.0))
        return total / count if count else 0.0


class Learner:
    """The learning pass that fills `context` and `units` from `exchanges`.

    `counters.misfits` counts replies that fit no request."""

    def __init__(
        self,
        exchanges: Iterable[RecordedExchange],
        context: VirtualContext,
        spans: RecordingCounters,
        counters: ReplayCounters,
    ) -> None:
        self.context = context
        self.units: dict[int, LearntUnit] = {}
        self._spans = spans
        self._counters = counters
        self._broadcasts: list[CellRequest] = []
        self._responses: dict[bytes, RECORDING] = {}  # one object for each distinct content
        self._learn_all(exchanges)
        for unit_id, unit in self.units.items():
            self._spread(unit_id, unit)
            unit.situations.rewind()

    def _learn_all(self, exchanges: Iterable[RecordedExchange]) -> None:
        """Learn all exchanges: reads go into columns, which is fast for known requests; all others are learned one by one."""
        units, size = self.units, 0
        for order, exchange in enumerate(exchanges):
            unit = units.get(exchange.unit)
            column = unit.columns.get(exchange.request) if unit is not None else None
            if unit is None or column is None or (exchange.unit == 0 and exchange.reply == b""):
                column = self._learn(exchange)
                unit = units.get(exchange.unit)
            if column is not None and unit is not None:
                if not column.add(order, exchange) and exchange.reply:
                    self._learn_odd(unit, column.request, exchange)
                size += column.stride + EXCHANGE_OVERHEAD_BYTES
                if size > MAX_BYTES:
                    self._drop_oldest(order)
                    size = sum(len(c) * (c.stride + EXCHANGE_OVERHEAD_BYTES) for c in self._columns())

    def _columns(self) -> Iterator[OutcomeColumn]:
        for unit in self.units.values():
            for columns in unit.by_situation.values():
                yield from columns.values()

    def _drop_oldest(self, order: int) -> None:
        """Drop the older half of the kept replies, so that a recording of days can be learned."""
        oldest = min((c.orders[0] for c in self._columns() if len(c)), default=order)
        for column in self._columns():
            self.context.dropped += column.drop_before((oldest + order) // 2)

    def _broadcast(self, request: CellRequest | None) -> None:
        if request is not None and request.values is not None:
            for unit in self.units.values():
                unit.write(request, request.values)

    def _learn_odd(self, unit: LearntUnit, request: CellRequest, exchange: RecordedExchange) -> None:
        """Learn a read that did not get a normal reply."""
        reply = exchange.reply or b""
        if requests.is_exception(exchange.request, reply):
            self._learn_refusal(unit, request, Recorded(exchange.t_s, self._response(reply), exchange.latency_s))
        else:
            self._counters.misfits += 1

    def _learn(self, exchange: RecordedExchange) -> OutcomeColumn | None:
        """Learn an exchange; return the new column for a read."""
        request = requests.parse_request(exchange.request)
        if exchange.unit == 0 and exchange.reply == b"":  # on TCP, unit 0 can be a device that answers
            if request is not None and request.values is not None and len(self._broadcasts) < MAX_ENTRIES:
                self._broadcasts.append(request)
            self._broadcast(request)
            for unit in self.units.values():
                self._note_situation(unit)
            return None
        unit = self._unit(exchange.unit)
        unit.functions.add(exchange.request[0])
        if request is not None and request.values is None:
            column = unit.columns[exchange.request] = OutcomeColumn(request, unit.situations.learned)
            return column
        if exchange.request[0] not in STANDARD_FUNCTIONS:
            unit.request_lengths.setdefault(exchange.request[0], set()).add(len(exchange.request))
        reply = exchange.reply or b""
        recorded = Recorded(exchange.t_s, self._response(reply), exchange.latency_s)
        self._add(unit, shape_key(exchange.unit, exchange.request), recorded)
        if not reply:
            return None
        count, total = unit.latency.get(exchange.request[0], (0, 0.0))
        unit.latency[exchange.request[0]] = (count + 1, total + exchange.latency_s)
        if request is None:
            return None
        if requests.is_exception(exchange.request, reply):
            self._learn_refusal(unit, request, recorded)
        elif requests.is_written(request, exchange.request, reply):
            unit.writable.update((request.table, address) for address in request.addresses)
            unit.write(request, request.values or ())
            self._note_situation(unit)
        else:
            self._counters.misfits += 1
        return None

    @staticmethod
    def _note_situation(unit: LearntUnit) -> None:
        unit.columns = unit.by_situation.setdefault(unit.situations.learned, {})

    def _spread(self, unit_id: int, unit: LearntUnit) -> None:
        """Convert the columns to the contents of the context: outcomes of each request, values of each cell."""
        columns = [c for found in unit.by_situation.values() for c in found.values() if len(c)]
        columns.sort(key=lambda c: c.orders[0])
        holding: dict[Cell, dict[int, list[tuple[OutcomeColumn, int]]]] = {}
        for column in columns:
            request, situation = column.request, column.situation
            shape = shape_key(unit_id, struct.pack(">BHH", request.function, request.address, request.count))
            unit.recorded_in.setdefault(shape, []).append(situation)
            self.context.add_series(COMMAND(in_situation(shape, situation)), Outcomes(column))
            self._count(unit, column)
            if len(column) > len(column.odd):
                for offset, address in enumerate(request.addresses):
                    found = holding.setdefault((request.table, address), {})
                    found.setdefault(situation, []).append((column, offset))
        counted = {cell for cell in holding if self._spans.counts(unit_id, cell)}
        self._count_on(unit_id, counted, columns)
        merges: dict[tuple[int, ...], Merged] = {}
        for cell, situations in holding.items():
            if cell in counted:
                continue
            key = cell_key(unit_id, cell)
            for situation, parts in situations.items():
                same = tuple(id(column) for column, _ in parts)
                merged = merges.get(same)
                if merged is None:
                    merged = merges[same] = Merged([column for column, _ in parts])
                unit.recorded_in.setdefault(key, []).append(situation)
                values = CellValues(merged, [offset for _, offset in parts])
                self.context.add_series(COMMAND(in_situation(key, situation)), values)
        unit.by_situation.clear()
        unit.columns = {}

    @staticmethod
    def _count(unit: LearntUnit, column: OutcomeColumn) -> None:
        """Learn the latency of reads, and the largest quantity that the device returns."""
        silent = [i for i, reply in column.odd.items() if not reply.data]
        function, answered = column.request.function, len(column) - len(silent)
        if answered:
            count, total = unit.latency.get(function, (0, 0.0))
            took_s = sum(column.latencies) - sum(column.latencies[i] for i in silent)
            unit.latency[function] = (count + answered, total + took_s)
        if len(column) > len(column.odd):
            unit.most_read[function] = max(column.request.count, unit.most_read.get(function, 0))

    def _count_on(self, unit_id: int, counted: set[Cell], columns: Sequence[OutcomeColumn]) -> None:
        """Learn the cells of counters, in recorded order because their values are assembled register by register."""
        if not counted:
            return
        having = [c for c in columns if any((c.request.table, a) in counted for a in c.request.addresses)]
        merged = Merged(having)
        for i in range(merged.size):
            number, place = merged.at(i)
            column = having[number]
            for offset, address in enumerate(column.request.addresses):
                cell = (column.request.table, address)
                if cell in counted:
                    recorded = column.cell(place, offset)
                    self._spans.learn(unit_id, cell, int.from_bytes(recorded.response.data), recorded.t_s)

    def _learn_refusal(self, unit: LearntUnit, request: CellRequest, recorded: Recorded) -> None:
        if request.values is not None:
            unit.refused_writes[request.function, request.address, request.count] = recorded
        elif recorded.response.data[1] == requests.ILLEGAL_VALUE:
            fewest = unit.least_refused.get(request.function, request.count)
            unit.least_refused[request.function] = min(request.count, fewest)

    def _unit(self, unit_id: int) -> LearntUnit:
        unit = self.units.get(unit_id)
        if unit is None:
            unit = self.units[unit_id] = LearntUnit()
            for request in self._broadcasts:
                unit.write(request, request.values or ())
            self._note_situation(unit)
        return unit

    def _add(self, unit: LearntUnit, key: bytes, recorded: Recorded) -> None:
        situation = unit.situations.learned
        seen = unit.recorded_in.setdefault(key, [])
        if situation not in seen:
            seen.append(situation)
        self.context.add(COMMAND(in_situation(key, situation)), recorded)

    def _response(self, data: bytes) -> RECORDING:
        return self._responses.setdefault(data, RECORDING(data))


def cell_key(unit_id: int, cell: Cell) -> bytes:
    return struct.pack(">BBH", unit_id, TABLE_CODES[cell[0]], cell[1])


def shape_key(unit_id: int, pdu: bytes) -> bytes:
    return bytes((unit_id, _SHAPE_CODE)) + pdu


def in_situation(key: bytes, situation: int) -> bytes:
    return key + situation.to_bytes(2, "big")
