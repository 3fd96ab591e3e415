"""A recorded unit on an emulated line: what a Modbus slave asks, answered by a replay.

It takes the place of a unit that computes its answers: same counters, same calls; what is registered on it, and exception
06 while it is to be busy, go before what was recorded. `latency_s` is what the last answer had taken
in the recording; whoever sends the reply may wait as long.
"""

from __future__ import annotations

from collections.abc import Sequence

from emulators.modbus.bank import IllegalAddress, RegisterBank, Table
from emulators.modbus.unit import Handler, ModbusUnit
from emulators.replay.replay import Answer, ExchangeReplay
from gateway.core.errors import UsageError


class _NoBank(RegisterBank):
    """A recorded unit computes nothing, so nothing is behind it."""

    def read(self, table: Table, address: int, count: int, now_ns: int) -> Sequence[int]:
        raise IllegalAddress(f"{table}:{address}")

    def write(self, table: Table, address: int, values: Sequence[int], now_ns: int) -> None:
        raise IllegalAddress(f"{table}:{address}")


class ReplayUnit(ModbusUnit):
    """Unit `unit_id` of a recording, which must hold it. It may be served under any id."""

    def __init__(self, replay: ExchangeReplay, unit_id: int, name: str = "") -> None:
        if unit_id not in replay.units:
            there = ", ".join(map(str, replay.units)) or "none"
            raise UsageError("the recording has no such unit", expected=there, got=str(unit_id))
        super().__init__(_NoBank(), name=name)
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
        """The recorded answer, None for silence. Exchanges are keyed by order, not by time."""
        if pdu and (pdu[0] in self._registered or now_ns < self._busy_until_ns):
            self.latency_s = 0.0
            return super().respond(pdu, now_ns)
        self.counters.requests += 1
        answer = self.recall(pdu)
        self.latency_s = answer.latency_s
        if answer.reply is None:
            self.counters.unanswered += 1
            return None
        self.counters.replies += 1
        self.counters.exceptions += bool(answer.reply[0] & 0x80)
        return answer.reply

    def recall(self, pdu: bytes) -> Answer:
        """What the recorded unit answers."""
        return self.replay.respond(self.unit_id, pdu)

    def execute_broadcast(self, pdu: bytes, now_ns: int) -> None:
        """A write to all units has its effect on this one too."""
        self.counters.broadcasts += 1
        self.counters.unanswered += 1
        self.replay.broadcast(pdu, self.unit_id)
