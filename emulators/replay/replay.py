"""A recorded Modbus device, answering again: SPEC ruling 3.

Values are resolved cell by cell (unit, table, address, what was written before), so that a master which splits or merges
the recorded ranges gets the same numbers. What concerns a request as a whole, an exception, a limit, silence, latency, is kept
by the request's shape. Everything is answered in recorded order from one `VirtualContext`, whose commands are the
cells and shapes.

Two words of one value stay together as long as they were always recorded together, which is how masters read; a counter's stay
together whatever happens (`counters`). Pure: PDUs in, PDUs out. It knows neither units' wires nor clocks.
"""

from __future__ import annotations

import copy
import struct
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from pathlib import Path

from emulators.context import MAX_ENTRIES, Recorded, UsedUp, VirtualContext, WhenUsedUp
from emulators.modbus.bank import Table
from emulators.modbus.register_functions import STANDARD_FUNCTIONS
from emulators.replay import requests
from emulators.replay.counters import Counters, CounterSpan
from emulators.replay.requests import CellRequest
from emulators.replay.situation import Cell, Situations
from gateway.core.errors import Bug
from gateway.core.recording import Exchange, RecordingReader
from gateway.core.values import COMMAND, RECORDING

_TABLE_CODES: dict[Table, int] = {"coil": 0, "discrete": 1, "holding": 3, "input": 4}
_SHAPE_CODE = 0xFF


class NeverRecorded(Enum):
    """What is answered to a request of which nothing was recorded; named in the prototype file."""

    EXCEPTION = "exception"
    SILENCE = "silence"


@dataclass(frozen=True, slots=True)
class Answer:
    """What the device says, None for silence, and how long it had taken it in the recording."""

    reply: bytes | None
    latency_s: float = 0.0


@dataclass(slots=True)
class ReplayCounters:
    """What a replay did. All but `misfits` count answers; `misfits` recorded replies that fit no request cell by cell."""

    answered: int = 0
    exceptions: int = 0
    silences: int = 0
    never_recorded: int = 0
    used_up: int = 0
    misfits: int = 0


class _Unit:
    """What is known of one unit besides the recordings themselves."""

    def __init__(self) -> None:
        self.situations = Situations()
        self.recorded_in: dict[bytes, list[int]] = {}  # cell or shape -> situations, in recorded order
        self.alike: dict[bytes, int] = {}  # the same -> the one to use in the present situation
        self.functions: set[int] = set()
        self.put: dict[Cell, int] = {}  # what the unit itself changed
        self.request_lengths: dict[int, set[int]] = {}  # function that no standard knows -> recorded lengths
        self.writable: set[Cell] = set()
        self.refused_writes: dict[tuple[int, int, int], Recorded] = {}
        self.most_read: dict[int, int] = {}  # function -> most cells ever answered
        self.least_refused: dict[int, int] = {}  # function -> fewest cells ever refused with 03
        self.latency: dict[int, tuple[int, float]] = {}  # function -> how many, sum

    def copy(self) -> _Unit:
        """What was learned, shared, with nothing asked or written yet."""
        other = copy.copy(self)
        other.situations, other.alike, other.put = self.situations.copy(), {}, {}
        return other

    def usual_latency_s(self, function: int) -> float:
        count, total = self.latency.get(function, (0, 0.0))
        return total / count if count else 0.0


class ExchangeReplay:
    """Answers requests from recorded exchanges.

    Of a recording that holds several units, each answers for itself; one that was never recorded stays silent. A write
    that was recorded is answered as it was, and changes what is read afterwards, as it did. A write of another value to
    cells that did accept writes is accepted, and they read back what was written. Anything else that was never recorded is
    answered with exception 01 (function), 02 (address) or 03 (more cells than the device ever gave), or not at all.
    Under `ERROR` a used-up recording is answered with exception 04 and counted.
    """

    def __init__(
        self,
        exchanges: Iterable[Exchange],
        *,
        when_used_up: WhenUsedUp = WhenUsedUp.HOLD,
        never_recorded: NeverRecorded = NeverRecorded.EXCEPTION,
        counters: Iterable[CounterSpan] = (),
        max_entries: int = MAX_ENTRIES,
    ) -> None:
        self.context = VirtualContext(when_used_up=when_used_up, max_entries=max_entries)
        self.when_used_up = when_used_up
        self.never_recorded = never_recorded
        self.counters = ReplayCounters()
        self.truncated = False
        self._spans = Counters(counters, self.context)
        self._units: dict[int, _Unit] = {}
        self._broadcasts: list[CellRequest] = []
        self._last_answers: dict[bytes, Recorded] = {}
        self._responses: dict[bytes, RECORDING] = {}  # one object for each distinct content
        for exchange in exchanges:
            self._learn(exchange)
        for unit in self._units.values():
            unit.situations.rewind()
        self._responses.clear()

    @classmethod
    def load(
        cls,
        path: Path,
        *,
        when_used_up: WhenUsedUp = WhenUsedUp.HOLD,
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
        """Another device of the same recording, from its beginning: what was learned is in memory once. This one must not
        have answered anything."""
        other = copy.copy(self)
        other.context = self.context.copy()
        other.counters = replace(self.counters)
        other._spans = self._spans.copy(other.context)
        other._units = {unit_id: unit.copy() for unit_id, unit in self._units.items()}
        other._last_answers = {}
        return other

    @property
    def units(self) -> tuple[int, ...]:
        """The unit ids that were recorded."""
        return tuple(sorted(self._units))

    def respond(self, unit_id: int, pdu: bytes) -> Answer:
        """What the recorded unit answers to `pdu` (function code and data) now."""
        if not pdu:
            return Answer(None)
        unit = self._units.get(unit_id)
        if unit is None:
            self.counters.never_recorded += 1
            return self._counted(pdu, Answer(None))
        try:
            return self._counted(pdu, self._answer(unit_id, unit, pdu))
        except UsedUp:
            self.counters.used_up += 1
            return self._counted(pdu, Answer(requests.exception(pdu, requests.DEVICE_FAILURE)))

    def broadcast(self, pdu: bytes, unit_id: int | None = None) -> None:
        """A request to all units of the line, as `unit_id` hears it, or all: writes have their effect, nobody answers."""
        request = requests.parse_request(pdu)
        if request is not None and request.values is not None:
            for number, unit in self._units.items():
                if unit_id in (None, number):
                    self._write(unit, request, request.values)

    def was_recorded(self, unit_id: int, pdu: bytes) -> bool:
        """Whether this very request was."""
        unit = self._units.get(unit_id)
        return unit is not None and _shape(unit_id, pdu) in unit.recorded_in

    def refuse(self, unit_id: int, pdu: bytes, code: int) -> Answer:
        """The answer to what the device is known not to do, though nobody recorded it."""
        latency_s = self._units[unit_id].usual_latency_s(pdu[0])
        return self._counted(pdu, Answer(requests.exception(pdu, code), latency_s))

    def accept(self, unit_id: int, request: CellRequest, pdu: bytes) -> Answer:
        """The answer to a write that the device is known to take, though nobody recorded it."""
        unit = self._units[unit_id]
        self._write(unit, request, request.values or ())
        latency_s = unit.usual_latency_s(pdu[0]) or unit.usual_latency_s(3)
        return self._counted(pdu, Answer(requests.written_reply(request, pdu), latency_s))

    def own_request_lengths(self, unit_id: int) -> dict[int, int]:
        """Functions that no standard knows, of which every recorded request was as long as the others: bytes of the PDU."""
        found = self._units[unit_id].request_lengths
        return {function: max(lengths) for function, lengths in found.items() if len(lengths) == 1}

    def put(self, unit_id: int, table: Table, address: int, values: Sequence[int]) -> None:
        """The unit itself changed these cells: they read so until they are written or put again, counters too."""
        self._units[unit_id].put.update({(table, address + i): value for i, value in enumerate(values)})

    def _counted(self, pdu: bytes, answer: Answer) -> Answer:
        if answer.reply is None:
            self.counters.silences += 1
        elif requests.is_exception(pdu, answer.reply):
            self.counters.exceptions += 1
        else:
            self.counters.answered += 1
        return answer

    # -- learning -------------------------------------------------------------------------------------------------

    def _learn(self, exchange: Exchange) -> None:
        request = requests.parse_request(exchange.request)
        if exchange.unit == 0 and exchange.reply == b"":  # on TCP, unit 0 may well be a device that answers
            if request is not None and request.values is not None and len(self._broadcasts) < MAX_ENTRIES:
                self._broadcasts.append(request)
            self.broadcast(exchange.request)
            return
        unit = self._unit(exchange.unit)
        unit.functions.add(exchange.request[0])
        if exchange.request[0] not in STANDARD_FUNCTIONS:
            unit.request_lengths.setdefault(exchange.request[0], set()).add(len(exchange.request))
        reply = exchange.reply or b""
        recorded = Recorded(exchange.t_s, self._response(reply), exchange.latency_s)
        self._add(unit, _shape(exchange.unit, exchange.request), recorded)
        if not reply:
            return
        count, total = unit.latency.get(exchange.request[0], (0, 0.0))
        unit.latency[exchange.request[0]] = (count + 1, total + exchange.latency_s)
        if request is None:
            return
        if requests.is_exception(exchange.request, reply):
            self._learn_refusal(unit, request, recorded)
        elif request.values is None:
            self._learn_read(exchange, unit, request, reply)
        elif requests.is_written(request, exchange.request, reply):
            unit.writable.update((request.table, address) for address in request.addresses)
            self._write(unit, request, request.values)
        else:
            self.counters.misfits += 1

    def _learn_read(self, exchange: Exchange, unit: _Unit, request: CellRequest, reply: bytes) -> None:
        values = requests.parse_values(request, reply)
        if values is None:
            self.counters.misfits += 1
            return
        unit.most_read[request.function] = max(request.count, unit.most_read.get(request.function, 0))
        for address, value in zip(request.addresses, values, strict=True):
            cell = (request.table, address)
            if not self._spans.learn(exchange.unit, cell, value, exchange.t_s):
                response = self._response(value.to_bytes(2, "big"))
                self._add(unit, _cell(exchange.unit, cell), Recorded(exchange.t_s, response))

    def _learn_refusal(self, unit: _Unit, request: CellRequest, recorded: Recorded) -> None:
        if request.values is not None:
            unit.refused_writes[request.function, request.address, request.count] = recorded
        elif recorded.response.data[1] == requests.ILLEGAL_VALUE:
            fewest = unit.least_refused.get(request.function, request.count)
            unit.least_refused[request.function] = min(request.count, fewest)

    def _unit(self, unit_id: int) -> _Unit:
        unit = self._units.get(unit_id)
        if unit is None:
            unit = self._units[unit_id] = _Unit()
            for request in self._broadcasts:
                self._write(unit, request, request.values or ())
        return unit

    def _add(self, unit: _Unit, key: bytes, recorded: Recorded) -> None:
        situation = unit.situations.learned
        seen = unit.recorded_in.setdefault(key, [])
        if situation not in seen:
            seen.append(situation)
        self.context.add(COMMAND(_in_situation(key, situation)), recorded)

    def _response(self, data: bytes) -> RECORDING:
        return self._responses.setdefault(data, RECORDING(data))

    # -- answering ------------------------------------------------------------------------------------------------

    def _answer(self, unit_id: int, unit: _Unit, pdu: bytes) -> Answer:
        request = requests.parse_request(pdu)
        outcome = self._outcome(unit, _shape(unit_id, pdu))
        if outcome is not None:
            reply = outcome.response.data
            if not reply:
                return Answer(None, outcome.latency_s)
            if request is None or requests.is_exception(pdu, reply):
                return Answer(reply, outcome.latency_s)
            if request.values is None and requests.parse_values(request, reply) is None:
                return Answer(reply, outcome.latency_s)  # a device's own mistake, kept as it was
            if request.values is not None:
                if requests.is_written(request, pdu, reply):
                    self._write(unit, request, request.values)
                return Answer(reply, outcome.latency_s)
            if not self._knows_all(unit_id, unit, request):
                return Answer(reply, outcome.latency_s)  # half a counter was recorded: all there is of it
            return Answer(self._read(unit_id, unit, request), outcome.latency_s)
        if request is None or pdu[0] not in unit.functions:
            known = pdu[0] in unit.functions
            if known and requests.leaves_the_table(pdu):
                return self._never(pdu, requests.ILLEGAL_ADDRESS)
            return self._never(pdu, requests.ILLEGAL_VALUE if known else requests.ILLEGAL_FUNCTION)
        if request.values is None:
            return self._answer_new_read(unit_id, unit, request, pdu)
        return self._answer_new_write(unit, request, request.values, pdu)

    def _answer_new_read(self, unit_id: int, unit: _Unit, request: CellRequest, pdu: bytes) -> Answer:
        """A range that was never recorded as such."""
        refused = unit.least_refused.get(request.function)
        if refused is not None and refused <= request.count > unit.most_read.get(request.function, 0):
            return Answer(requests.exception(pdu, requests.ILLEGAL_VALUE), unit.usual_latency_s(request.function))
        if not self._knows_all(unit_id, unit, request):
            return self._never(pdu, requests.ILLEGAL_ADDRESS)
        return Answer(self._read(unit_id, unit, request), unit.usual_latency_s(request.function))

    def _answer_new_write(self, unit: _Unit, request: CellRequest, values: tuple[int, ...], pdu: bytes) -> Answer:
        """A range or a value that was never recorded as such."""
        if all((request.table, address) in unit.writable for address in request.addresses):
            self._write(unit, request, values)
            return Answer(requests.written_reply(request, pdu), unit.usual_latency_s(request.function))
        refused = unit.refused_writes.get((request.function, request.address, request.count))
        if refused is not None:
            return Answer(refused.response.data, refused.latency_s)
        return self._never(pdu, requests.ILLEGAL_ADDRESS)

    def _never(self, pdu: bytes, code: int) -> Answer:
        self.counters.never_recorded += 1
        if self.never_recorded is NeverRecorded.SILENCE:
            return Answer(None)
        return Answer(requests.exception(pdu, code))

    def _outcome(self, unit: _Unit, shape: bytes) -> Recorded | None:
        """What came of a request of this shape, in recorded order; None when there never was one.

        Silence is an event and no state: when the recordings are used up, `HOLD` stays on the last answer, if there was any.
        """
        situations = unit.recorded_in.get(shape)
        if situations is None:
            return None
        command = COMMAND(_in_situation(shape, self._choose(unit, shape, situations)))
        used_up = not self.context.left(command)
        outcome = self.context.take_recorded(command)
        if outcome.response.data:
            self._last_answers[command.data] = outcome
        elif used_up and self.when_used_up is WhenUsedUp.HOLD:
            return self._last_answers.get(command.data, outcome)
        return outcome

    def _read(self, unit_id: int, unit: _Unit, request: CellRequest) -> bytes:
        self._spans.begin(unit_id, request.table, request.addresses)
        values = [self._value(unit_id, unit, (request.table, address)) for address in request.addresses]
        return requests.read_reply(request, values)

    def _knows(self, unit_id: int, unit: _Unit, cell: Cell) -> bool:
        return (
            cell in unit.put
            or _cell(unit_id, cell) in unit.recorded_in
            or self._spans.knows(unit_id, cell)
            or unit.situations.written(cell) is not None
        )

    def _knows_all(self, unit_id: int, unit: _Unit, request: CellRequest) -> bool:
        return all(self._knows(unit_id, unit, (request.table, address)) for address in request.addresses)

    def _value(self, unit_id: int, unit: _Unit, cell: Cell) -> int:
        """One cell: from its counter, or as recorded after the same writes, or as it was written."""
        if cell in unit.put:
            return unit.put[cell]
        if self._spans.knows(unit_id, cell):
            return self._spans.read(unit_id, cell)
        key, written = _cell(unit_id, cell), unit.situations.written(cell)
        recorded_in = unit.recorded_in.get(key, [])
        situation = unit.alike.get(key)
        if situation is None:
            own = [s for s in recorded_in if unit.situations.written_in(s, cell) == written]
            if written is not None and not own:
                return written
            if not recorded_in:
                raise Bug("an unknown cell was read", where=f"unit {unit_id}, {cell[0]}:{cell[1]}")
            situation = self._choose(unit, key, own or recorded_in)
        return int.from_bytes(self.context.take(COMMAND(_in_situation(key, situation))).data, "big")

    @staticmethod
    def _choose(unit: _Unit, key: bytes, situations: list[int]) -> int:
        """The recorded situation to use; remembered until the next write."""
        if key not in unit.alike:
            unit.alike[key] = unit.situations.most_alike(situations)
        return unit.alike[key]

    @staticmethod
    def _write(unit: _Unit, request: CellRequest, values: tuple[int, ...]) -> None:
        unit.situations.write(request.table, request.address, values)
        unit.alike.clear()
        if unit.put:
            for address in request.addresses:
                unit.put.pop((request.table, address), None)


def _cell(unit_id: int, cell: Cell) -> bytes:
    return struct.pack(">BBH", unit_id, _TABLE_CODES[cell[0]], cell[1])


def _shape(unit_id: int, pdu: bytes) -> bytes:
    return bytes((unit_id, _SHAPE_CODE)) + pdu


def _in_situation(key: bytes, situation: int) -> bytes:
    return key + situation.to_bytes(2, "big")
