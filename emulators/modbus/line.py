"""Several units on one serial line (MODBUS over Serial Line V1.02, SL below), for every frame format.

A unit answers requests addressed to it, executes broadcasts (unit ID 0), and ignores everything else: the traffic of other
units, damaged frames, noise. This module performs no I/O and never waits; the caller delays replies. A subclass separates and
builds the frames.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import msgspec

from fieldtwin.emulators.modbus.unit import ModbusUnit
from fieldtwin.gateway.core.errors import UsageError

BROADCAST = 0
LOWEST_UNIT, HIGHEST_UNIT = 1, 247


class ServedFrame(msgspec.Struct, frozen=True, gc=False):
    """A complete frame that was received, and the complete frame to send in reply; empty if there is no reply.

    `latency_s` is the processing time that the unit states for this reply (`ModbusUnit.latency_s`).
    """

    heard: bytes
    reply: bytes = b""
    latency_s: float = 0.0


@dataclass(frozen=True, slots=True)
class UnitLineCounters:
    """Traffic counters of a line.

    `frames` are complete frames, whatever their unit ID; `crc_errors` are damaged frames, with wrong LRCs and
    violations of strict timing included; `noise_bytes` are all bytes that belong to no frame.
    """

    frames: int
    crc_errors: int
    noise_bytes: int


class Receiver(Protocol):
    """The interface of a receiver, which finds the frames in the bytes of a line.

    `feed` returns the frames without delimiters, with their checksum."""

    gap_ns: int
    frames: int
    crc_errors: int
    noise_bytes: int

    @property
    def pending(self) -> int: ...

    def feed(self, data: bytes, now_ns: int) -> list[bytes]: ...


class LineServer(ABC):
    """The server for the units of one line. `units` maps a unit ID (1 to 247) to its unit."""

    check_bytes: int
    """The number of checksum bytes at the end of a received frame."""

    def __init__(self, units: Mapping[int, ModbusUnit], receiver: Receiver) -> None:
        for unit_id in units:
            if not LOWEST_UNIT <= unit_id <= HIGHEST_UNIT:
                raise UsageError("unit id on a serial line", expected="1 to 247", got=str(unit_id))
        self.units = dict(units)
        self._receiver = receiver

    @property
    def counters(self) -> UnitLineCounters:
        return UnitLineCounters(self._receiver.frames, self._receiver.crc_errors, self._receiver.noise_bytes)

    @property
    def gap_ns(self) -> int:
        """Return the pause after which an unfinished frame cannot continue."""
        return self._receiver.gap_ns

    @property
    def pending(self) -> int:
        """Return the number of bytes of an incomplete frame; feed ``b""`` after `gap_ns` of silence to discard them."""
        return self._receiver.pending

    def feed(self, data: bytes, now_ns: int) -> list[bytes]:
        """Return the replies to the frames that are now complete, in order.

        `now_ns` is the time at which `data` arrived; it never goes back.
        """
        return [exchange.reply for exchange in self.receive(data, now_ns) if exchange.reply]

    def receive(self, data: bytes, now_ns: int) -> list[ServedFrame]:
        """Handle received bytes as `feed` does, and return every received frame with its reply, for sniffers and journals."""
        errors_before = self._receiver.crc_errors
        frames = self._receiver.feed(data, now_ns)
        errors = self._receiver.crc_errors - errors_before
        if errors:
            for unit in self.units.values():
                unit.heard(errors=errors)
        return [self._exchange(frame, now_ns) for frame in frames]

    @abstractmethod
    def encode(self, frame: bytes) -> bytes:
        """Return `frame` (unit ID and PDU) as it is sent on the line."""

    def as_heard(self, frame: bytes) -> bytes:
        """Return a received frame with its delimiters, exactly as it was on the line."""
        return frame

    def _exchange(self, frame: bytes, now_ns: int) -> ServedFrame:
        for unit in self.units.values():
            unit.counters.bus_messages += 1
        heard = self.as_heard(frame)
        unit_id, pdu = frame[0], frame[1 : -self.check_bytes]
        if unit_id == BROADCAST:
            for unit in self.units.values():
                unit.execute_broadcast(pdu, now_ns)
            return ServedFrame(heard)
        addressed = self.units.get(unit_id)
        if addressed is None:
            return ServedFrame(heard)
        response = addressed.respond(pdu, now_ns)
        if response is None:
            return ServedFrame(heard)
        if len(self.units) > 1:
            for (
                unit
                # the other units also receive the reply, while the receiver of the sending unit is switched off
            ) in self.units.values():
                if unit is not addressed:
                    unit.heard(messages=1)
        return ServedFrame(heard, self.encode(bytes((unit_id,)) + response), addressed.latency_s)
