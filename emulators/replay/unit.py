"""A Modbus unit of an emulated line that answers from a recording.

It has the same counters and methods as a unit that computes its answers. Functions added with `register`, and exception 06
while the unit is busy, take precedence over the recording. `latency_s` is the recorded latency of the last answer, which the
sender of the reply may use as a delay.
"""

from __future__ import annotations

from collections.abc import Sequence

from fieldtwin.emulators.modbus.bank import NoSuchAddress, RegisterBank, Table
from fieldtwin.emulators.modbus.unit import WHILE_BUSY, Handler, ModbusUnit, UnitParts
from fieldtwin.emulators.replay.replay import ExchangeReplay, ReplayedReply
from fieldtwin.gateway.core.errors import UsageError


class _NoBank(RegisterBank):
    """An empty bank, because a recorded unit computes no answers."""

    def read(self, table: Table, address: int, count: int, now_ns: int) -> Sequence[int]:
        raise NoSuchAddress(f"{table}:{address}")

    def write(self, table: Table, address: int, values: Sequence[int], now_ns: int) -> None:
        raise NoSuchAddress(f"{table}:{address}")


class ReplayUnit(ModbusUnit):
    """The unit `unit_id` of a recording, which must contain it. It may be served under any unit ID."""

    def __init__(self, replay: ExchangeReplay, unit_id: int, name: str = "", parts: UnitParts | None = None) -> None:
        if unit_id not in replay.units:
            there = ", ".join(map(str, replay.units)) or "none"
            raise UsageError("the recording has no such unit", expected=there, got=str(unit_id))
        super().__init__(_NoBank(), name=name, **(parts or UnitParts()))
        self.replay = replay
        self.unit_id = unit_id
        self.latency_s = 0.0
        self._registered: set[int] = set()
        self.request_lengths.update(replay.own_request_lengths(unit_id))

    def register(
        self, function: int, handler: Handler, *, broadcast: bool = False, request_length: int | None = None
    ) -> None:
        super().register(function, handler, broadcast=broadcast, request_length=request_length)
        self._registered.add(function)

    def respond(self, pdu: bytes, now_ns: int) -> bytes | None:
        """Return the response PDU, usually the next recorded one; None if the unit sends no response.

        Recorded responses are selected by their order, not by `now_ns`.
        """
        busy = now_ns < self._busy_until_ns
        if pdu and (self.computes(pdu) or (busy and pdu[0] not in WHILE_BUSY) or self.diagnostics.listen_only):
            self.latency_s = 0.0
            return super().respond(pdu, now_ns)
        self.counters.requests += 1
        self.diagnostics.log.note_received()
        answer = self.recall(pdu)
        self._count_towards_busy(now_ns)
        self.latency_s = answer.latency_s
        if answer.reply is None:
            self.counters.unanswered += 1
            return None
        self._count_reply(pdu, answer.reply)
        return answer.reply

    def _count_reply(self, pdu: bytes, reply: bytes) -> None:
        self.counters.replies += 1
        self.diagnostics.log.note_sent(reply)
        if not reply[0] & 0x80:
            self.diagnostics.completed(pdu)
            return
        self.counters.exceptions += 1
        self.counters.busy += reply[1:2] == b"\x06"
        self.counters.naks += reply[1:2] == b"\x07"

    def computes(self, pdu: bytes) -> bool:
        """Return whether the unit computes this answer itself, regardless of the recording."""
        return pdu[0] in self._registered

    def recall(self, pdu: bytes) -> ReplayedReply:
        """Return the next answer of the recorded unit to `pdu`."""
        return self.replay.respond(self.unit_id, pdu)

    def execute_broadcast(self, pdu: bytes, now_ns: int) -> None:
        """Execute a broadcast write on this unit."""
        self.counters.broadcasts += 1
        self.counters.unanswered += 1
        self.diagnostics.log.note_received(listening=self.diagnostics.listen_only, broadcast=True)
        if not self.diagnostics.listen_only:
            self.replay.broadcast(pdu, self.unit_id)
