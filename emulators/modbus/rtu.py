"""Modbus RTU, server side: several units on one line (MODBUS over Serial Line V1.02, SL below).

Pure. A unit answers what is addressed to it, executes what is addressed to 0, and keeps silent about all else: other
units' traffic, damaged frames, noise. Pacing and waiting happen elsewhere.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from emulators.modbus.rtu_receiver import FRAME_GAP_NS, RtuReceiver, with_crc
from emulators.modbus.unit import ModbusUnit
from gateway.core.errors import UsageError

BROADCAST = 0
LOWEST_UNIT, HIGHEST_UNIT = 1, 247


@dataclass(frozen=True, slots=True)
class Exchange:
    """A whole frame that was heard, and the whole frame to send for it; empty when there is nothing to say."""

    heard: bytes
    reply: bytes = b""


@dataclass(frozen=True, slots=True)
class LineCounters:
    """What went over the line so far. `frames` are whole, for whomever; the others: `RtuReceiver`."""

    frames: int
    crc_errors: int
    noise_bytes: int


class RtuSlave:
    """The units of one line. `units`: unit id (1 to 247) -> unit; `gap_ns`: after which pause no frame goes on."""

    def __init__(self, units: Mapping[int, ModbusUnit], gap_ns: int = FRAME_GAP_NS) -> None:
        for unit_id in units:
            if not LOWEST_UNIT <= unit_id <= HIGHEST_UNIT:
                raise UsageError("unit id on a serial line", expected="1 to 247", got=str(unit_id))
        self.units = dict(units)
        self._receiver = RtuReceiver(frozenset(units), gap_ns)

    @property
    def counters(self) -> LineCounters:
        return LineCounters(self._receiver.frames, self._receiver.crc_errors, self._receiver.noise_bytes)

    @property
    def gap_ns(self) -> int:
        return self._receiver.gap_ns

    @property
    def pending(self) -> int:
        """Bytes of a frame that is not whole; feed ``b""`` after `gap_ns` of silence to be rid of them."""
        return self._receiver.pending

    def feed(self, data: bytes, now_ns: int) -> list[bytes]:
        """Replies to what is whole now, in order. `now_ns`: when `data` came; it never goes back."""
        return [exchange.reply for exchange in self.receive(data, now_ns) if exchange.reply]

    def receive(self, data: bytes, now_ns: int) -> list[Exchange]:
        """Like `feed`, with every frame that was heard, for taps and journals."""
        errors_before = self._receiver.crc_errors
        frames = self._receiver.feed(data, now_ns)
        errors = self._receiver.crc_errors - errors_before
        if errors:
            for unit in self.units.values():
                unit.heard(errors=errors)
        return [Exchange(frame, self._execute(frame, now_ns)) for frame in frames]

    def _execute(self, frame: bytes, now_ns: int) -> bytes:
        for unit in self.units.values():
            unit.heard(messages=1)
        unit_id, pdu = frame[0], frame[1:-2]
        if unit_id == BROADCAST:
            for unit in self.units.values():
                unit.execute_broadcast(pdu, now_ns)
            return b""
        addressed = self.units.get(unit_id)
        response = addressed.respond(pdu, now_ns) if addressed else None
        if response is None:
            return b""
        for unit in self.units.values():
            if unit is not addressed:  # a reply is a message to its neighbours; the sender's receiver is off meanwhile
                unit.heard(messages=1)
        return with_crc(bytes((unit_id,)) + response)
