"""Replays a recorded Modbus device (docs/explanation/paper.md, ruling 3).

Values are resolved cell by cell (unit, table, address, earlier writes), so a client that splits or merges the recorded ranges
gets the same numbers. Properties of a whole request (an exception, a limit, a missing reply, latency) are kept by the request's
shape: its function, address and count. All answers come in recorded order from one `VirtualContext`, whose commands are the cells
and shapes.

The registers of one value stay together if they were always recorded together, which is how clients read; those of a
counter always stay together (`counters`). Only `load` performs I/O, and no clock is read: requests and responses are
PDUs.
"""

from __future__ import annotations

import copy
from bisect import bisect
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from pathlib import Path

from fieldtwin.emulators.context import MAX_ENTRIES, EndOfRecording, Recorded, UsedUp, VirtualContext
from fieldtwin.emulators.modbus.bank import Table
from fieldtwin.emulators.replay import requests
from fieldtwin.emulators.replay.counters import CounterSpan, RecordingCounters
from fieldtwin.emulators.replay.learning import (
    CELL_KEY,
    TABLE_CODES,
    Learner,
    LearntUnit,
    ReplayCounters,
    cell_key,
    in_situation,
    shape_key,
)
from fieldtwin.emulators.replay.requests import CellRequest
from fieldtwin.emulators.replay.situation import Cell
from fieldtwin.gateway.core.errors import Bug
from fieldtwin.gateway.core.files.recording import RecordedExchange, RecordingReader
from fieldtwin.gateway.core.values import COMMAND


class NeverRecorded(Enum):
    """The answer to a request that was not recorded; named in the prototype file."""

    EXCEPTION = "exception"
    SILENCE = "silence"
    INTERPOLATE = "interpolate"
    """Like `EXCEPTION`, but a register between two recorded ones is interpolated linearly, and a bit takes the value of
    the one below.
    """


@dataclass(frozen=True, slots=True)
class ReplayedReply:
    """The device's reply, None if it sent none, and the recorded latency in seconds."""

    reply: bytes | None
    latency_s: float = 0.0


class ExchangeReplay:
    """A device that answers requests from recorded exchanges.

    If a recording contains several units, each answers for itself; a unit that was not recorded stays silent. A
    recorded write is answered as recorded, and changes later reads as recorded. A write of a different value to cells
    that accepted writes is accepted, and can be read back. All other requests that were not recorded are answered with
    exception 01 (function), 02 (address) or 03 (more cells than the device ever returned), or not at all. With `ERROR`,
    a used-up recording is answered with exception 04 and counted.
    """

    def __init__(
        self,
        exchanges: Iterable[RecordedExchange],
        *,
        when_used_up: EndOfRecording = EndOfRecording.HOLD,
        never_recorded: NeverRecorded = NeverRecorded.EXCEPTION,
        counters: Iterable[CounterSpan] = (),
        max_entries: int = MAX_ENTRIES,
    ) -> None:
        self.context = VirtualContext(when_used_up=when_used_up, max_entries=max_entries)
        self.when_used_up = when_used_up
        self.never_recorded = never_recorded
        self.counters = ReplayCounters()
        self.truncated = False
        self._spans = RecordingCounters(counters, self.context)
        self._last_answers: dict[bytes, Recorded] = {}
        self._units = Learner(exchanges, self.context, self._spans, self.counters).units

    @classmethod
    def load(
        cls,
        path: Path,
        *,
        when_used_up: EndOfRecording = EndOfRecording.HOLD,
        never_recorded: NeverRecorded = NeverRecorded.EXCEPTION,
        counters: Iterable[CounterSpan] = (),
    ) -> ExchangeReplay:
        """Read a recording of exchanges; raises `FileInvalid`. `truncated` says that its last line was cut off."""
        with RecordingReader(path) as reader:
            replay = cls(
                reader.exchanges(), when_used_up=when_used_up, never_recorded=never_recorded, counters=counters
            )
            replay.truncated = reader.truncated
            return replay

    def copy(self) -> ExchangeReplay:
        """Return a device with the same recording, in its initial state, which shares the learned data.

        Call it before this device has answered a request.
        """
        other = copy.copy(self)
        other.context = self.context.copy()
        other.counters = replace(self.counters)
        other._spans = self._spans.copy(other.context)
        other._units = {unit_id: unit.copy() for unit_id, unit in self._units.items()}
        other._last_answers = {}
        return other

    @property
    def units(self) -> tuple[int, ...]:
        """Return the unit IDs that were recorded."""
        return tuple(sorted(self._units))

    def respond(self, unit_id: int, pdu: bytes) -> ReplayedReply:
        """Return the recorded unit's next answer to `pdu` (function code and data)."""
        if not pdu:
            return ReplayedReply(None)
        unit = self._units.get(unit_id)
        if unit is None:
            self.counters.never_recorded += 1
            return self._counted(pdu, ReplayedReply(None))
        try:
            return self._counted(pdu, self._answer(unit_id, unit, pdu))
        except UsedUp:
            self.counters.used_up += 1
            return self._counted(pdu, ReplayedReply(requests.exception(pdu, requests.DEVICE_FAILURE)))

    def broadcast(self, pdu: bytes, unit_id: int | None = None) -> None:
        """Execute a broadcast on the unit `unit_id`, or on all units if it is None: writes take effect, and no unit answers."""
        request = requests.parse_request(pdu)
        if request is not None and request.values is not None:
            for number, unit in self._units.items():
                if unit_id in (None, number):
                    unit.write(request, request.values)

    def was_recorded(self, unit_id: int, pdu: bytes) -> bool:
        """Return whether exactly this request was recorded."""
        unit = self._units.get(unit_id)
        return unit is not None and shape_key(unit_id, pdu) in unit.recorded_in

    def refuse(self, unit_id: int, pdu: bytes, code: int) -> ReplayedReply:
        """Return the answer to a request that the device is known to refuse, although it was not recorded."""
        latency_s = self._units[unit_id].usual_latency_s(pdu[0])
        return self._counted(pdu, ReplayedReply(requests.exception(pdu, code), latency_s))

    def accept(self, unit_id: int, request: CellRequest, pdu: bytes) -> ReplayedReply:
        """Return the answer to a write that the device is known to accept, although it was not recorded."""
        unit = self._units[unit_id]
        unit.write(request, request.values or ())
        latency_s = unit.usual_latency_s(pdu[0]) or unit.usual_latency_s(3)
        return self._counted(pdu, ReplayedReply(requests.written_reply(request, pdu), latency_s))

    def own_request_lengths(self, unit_id: int) -> dict[int, int]:
        """Return the PDU lengths, in bytes, of non-standard functions whose recorded requests all have the same length."""
        found = self._units[unit_id].request_lengths
        return {function: max(lengths) for function, lengths in found.items() if len(lengths) == 1}

    def knows(self, unit_id: int, table: Table, address: int) -> bool:
        """Return whether a cell was recorded, written by a client, or set with `put`."""
        return self._knows(unit_id, self._units[unit_id], (table, address))

    def put(self, unit_id: int, table: Table, address: int, values: Sequence[int]) -> None:
        """Set cells for the device itself, also those of counters. They keep these values until they are written or put again."""
        self._units[unit_id].put.update({(table, address + i): value for i, value in enumerate(values)})

    def _counted(self, pdu: bytes, answer: ReplayedReply) -> ReplayedReply:
        if answer.reply is None:
            self.counters.silences += 1
        elif requests.is_exception(pdu, answer.reply):
            self.counters.exceptions += 1
        else:
            self.counters.answered += 1
        return answer

    # -- answering ------------------------------------------------------------------------------------------------

    def _answer(self, unit_id: int, unit: LearntUnit, pdu: bytes) -> ReplayedReply:
        request = requests.parse_request(pdu)
        outcome = self._outcome(unit, shape_key(unit_id, pdu))
        if outcome is not None:
            reply = outcome.response.data
            if not reply:
                return ReplayedReply(None, outcome.latency_s)
            if request is None or requests.is_exception(pdu, reply):
                return ReplayedReply(reply, outcome.latency_s)
            if request.values is None and requests.parse_values(request, reply) is None:
                # the device itself made this mistake, which is replayed as recorded
                return ReplayedReply(reply, outcome.latency_s)
            if request.values is not None:
                if requests.is_written(request, pdu, reply):
                    unit.write(request, request.values)
                return ReplayedReply(reply, outcome.latency_s)
            if not self._knows_all(unit_id, unit, request):
                return ReplayedReply(reply, outcome.latency_s)  # only part of a counter was recorded: return that part
            return ReplayedReply(self._read(unit_id, unit, request), outcome.latency_s)
        if request is None or pdu[0] not in unit.functions:
            known = pdu[0] in unit.functions
            if known and requests.leaves_the_table(pdu):
                return self._never(pdu, requests.ILLEGAL_ADDRESS)
            return self._never(pdu, requests.ILLEGAL_VALUE if known else requests.ILLEGAL_FUNCTION)
        if request.values is None:
            return self._answer_new_read(unit_id, unit, request, pdu)
        return self._answer_new_write(unit, request, request.values, pdu)

    def _answer_new_read(self, unit_id: int, unit: LearntUnit, request: CellRequest, pdu: bytes) -> ReplayedReply:
        """Answer a read of a range that was not recorded."""
        refused = unit.least_refused.get(request.function)
        if refused is not None and refused <= request.count > unit.most_read.get(request.function, 0):
            return ReplayedReply(
                requests.exception(pdu, requests.ILLEGAL_VALUE), unit.usual_latency_s(request.function)
            )
        if not self._knows_all(unit_id, unit, request) and not self._between_all(unit_id, unit, request):
            return self._never(pdu, requests.ILLEGAL_ADDRESS)
        return ReplayedReply(self._read(unit_id, unit, request), unit.usual_latency_s(request.function))

    def _answer_new_write(
        self, unit: LearntUnit, request: CellRequest, values: tuple[int, ...], pdu: bytes
    ) -> ReplayedReply:
        """Answer a write of a range or a value that was not recorded."""
        if all((request.table, address) in unit.writable for address in request.addresses):
            unit.write(request, values)
            return ReplayedReply(requests.written_reply(request, pdu), unit.usual_latency_s(request.function))
        refused = unit.refused_writes.get((request.function, request.address, request.count))
        if refused is not None:
            return ReplayedReply(refused.response.data, refused.latency_s)
        return self._never(pdu, requests.ILLEGAL_ADDRESS)

    def _never(self, pdu: bytes, code: int) -> ReplayedReply:
        self.counters.never_recorded += 1
        if self.never_recorded is NeverRecorded.SILENCE:
            return ReplayedReply(None)
        return ReplayedReply(requests.exception(pdu, code))

    def _outcome(self, unit: LearntUnit, shape: bytes) -> Recorded | None:
        """Return the outcome of a request of this shape, in recorded order; None if none was recorded.

        When the recordings are used up, `HOLD` repeats the last reply. A missing reply, which was a
        single event, is not repeated.
        """
        situations = unit.recorded_in.get(shape)
        if situations is None:
            return None
        command = COMMAND(in_situation(shape, self._choose(unit, shape, situations)))
        used_up = not self.context.left(command)
        outcome = self.context.take_recorded(command)
        if outcome.response.data:
            self._last_answers[command.data] = outcome
        elif used_up and self.when_used_up is EndOfRecording.HOLD:
            return self._last_answers.get(command.data, outcome)
        return outcome

    def _read(self, unit_id: int, unit: LearntUnit, request: CellRequest) -> bytes:
        self._spans.begin(unit_id, request.table, request.addresses)
        values = [self._value(unit_id, unit, (request.table, address)) for address in request.addresses]
        return requests.read_reply(request, values)

    def _knows(self, unit_id: int, unit: LearntUnit, cell: Cell) -> bool:
        return (
            cell in unit.put
            or cell_key(unit_id, cell) in unit.recorded_in
            or self._spans.knows(unit_id, cell)
            or unit.situations.written(cell) is not None
        )

    def _knows_all(self, unit_id: int, unit: LearntUnit, request: CellRequest) -> bool:
        return all(self._knows(unit_id, unit, (request.table, address)) for address in request.addresses)

    def _value(self, unit_id: int, unit: LearntUnit, cell: Cell) -> int:
        """Return the value of one cell: its counter's value, the value recorded after the same writes, or the written value."""
        if cell in unit.put:
            return unit.put[cell]
        if self.never_recorded is NeverRecorded.INTERPOLATE and not self._knows(unit_id, unit, cell):
            return self._interpolated(unit_id, unit, cell)
        if self._spans.knows(unit_id, cell):
            return self._spans.read(unit_id, cell)
        key, written = cell_key(unit_id, cell), unit.situations.written(cell)
        recorded_in = unit.recorded_in.get(key, [])
        situation = unit.alike.get(key)
        if situation is None:
            own = [s for s in recorded_in if unit.situations.written_in(s, cell) == written]
            if written is not None and not own:
                return written
            if not recorded_in:
                raise Bug("an unknown cell was read", where=f"unit {unit_id}, {cell[0]}:{cell[1]}")
            situation = self._choose(unit, key, own or recorded_in)
        return int.from_bytes(self.context.take(COMMAND(in_situation(key, situation))).data, "big")

    def _neighbours(self, unit: LearntUnit, cell: Cell) -> tuple[int, int] | None:
        """Return the nearest recorded addresses below and above an unknown cell; None outside of the recorded range."""
        if unit.addresses is None:
            tables: dict[Table, list[int]] = {table: [] for table in TABLE_CODES}
            names = {code: table for table, code in TABLE_CODES.items()}
            for key in unit.recorded_in:
                if len(key) == CELL_KEY and key[1] in names:
                    tables[names[key[1]]].append(int.from_bytes(key[2:4]))
            unit.addresses = {table: sorted(found) for table, found in tables.items()}
        known = unit.addresses[cell[0]]
        at = bisect(known, cell[1])
        return (known[at - 1], known[at]) if 0 < at < len(known) else None

    def _between_all(self, unit_id: int, unit: LearntUnit, request: CellRequest) -> bool:
        """Return whether all unknown cells lie between known cells and may be interpolated."""
        if self.never_recorded is not NeverRecorded.INTERPOLATE:
            return False
        cells = [(request.table, address) for address in request.addresses]
        return all(self._knows(unit_id, unit, c) or self._neighbours(unit, c) is not None for c in cells)

    def _interpolated(self, unit_id: int, unit: LearntUnit, cell: Cell) -> int:
        table, address = cell
        neighbours = self._neighbours(unit, cell)
        if neighbours is None:
            raise Bug("a cell with no neighbours was read", where=f"unit {unit_id}, {table}:{address}")
        below, above = neighbours
        low = self._now(unit_id, unit, (table, below))
        if table in ("coil", "discrete"):
            return low
        high = self._now(unit_id, unit, (table, above))
        return low + round((high - low) * (address - below) / (above - below))

    def _now(self, unit_id: int, unit: LearntUnit, cell: Cell) -> int:
        """Return the value of a recorded cell that was read last, else its first value. The recording does not advance."""
        if cell in unit.put:
            return unit.put[cell]
        key, written = cell_key(unit_id, cell), unit.situations.written(cell)
        situations = unit.recorded_in[key]
        if written is not None and not any(unit.situations.written_in(s, cell) == written for s in situations):
            return written
        recorded = self.context.peek(COMMAND(in_situation(key, self._choose(unit, key, situations))))
        return int.from_bytes(recorded.response.data) if recorded is not None else 0

    @staticmethod
    def _choose(unit: LearntUnit, key: bytes, situations: list[int]) -> int:
        """Return the recorded situation that is most similar to the present one. The result is cached until the next write."""
        if key not in unit.alike:
            unit.alike[key] = unit.situations.most_similar(situations)
        return unit.alike[key]
