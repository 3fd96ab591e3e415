"""Modbus TCP, server side, for one connection (MODBUS Messaging on TCP/IP Implementation Guide V1.0b, TG below).

Pure: bytes or datagrams in, response ADUs out, in the order of the requests. It never knows sockets, and no other
connection. Inside TLS it is the same; what a client's certificate allows is asked of whoever knows.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

from fieldtwin.emulators.endpoints.client_counts import Counts
from fieldtwin.emulators.modbus.line import Exchange
from fieldtwin.emulators.modbus.unit import ModbusUnit
from fieldtwin.gateway.core.errors import Desync, UsageError

HEADER = 6
"""Transaction id, protocol id and length: what precedes the bytes that the length counts (TG 3.1.3)."""
MIN_LENGTH, MAX_LENGTH = 2, 254
"""Unit id and function; unit id and the largest PDU of 253 bytes."""
MAX_IN_FLIGHT = 16
"""TG 4.4.2.2 names 1 to 16 as usual for a server."""
ANY_UNIT = (0, 255)
"""Unit ids that mean the device itself, where there is only one behind the address (TG 4.4.1.2)."""
NO_PATH = 0x0A

Allow = Callable[[int, bytes], bool]
"""``(unit id, pdu)`` -> whether this client may ask for that."""


class MbapSlave:
    """The units behind one connection. `units`: unit id -> unit.

    With a single unit, ids 0 and 255 reach it too, and are echoed; with `any_unit` every id does, as with devices that ignore
    it. A unit id that no unit has is answered with exception 0A, as a gateway does without a route. At most
    `max_in_flight` requests of those that came together are executed; the rest gets exception 06.

    A request that `allow` refuses gets exception 01 (MODBUS/TCP Security, 8.3), unexecuted; without it all are allowed.

    `desync` says why nothing more is understood: a length that no ADU can have leaves no way to find the next one.
    The connection is to be closed then; what is fed later is dropped.
    """

    def __init__(
        self,
        units: Mapping[int, ModbusUnit],
        max_in_flight: int = MAX_IN_FLIGHT,
        allow: Allow | None = None,
        counts: Counts | None = None,
        *,
        any_unit: bool = False,
    ) -> None:
        if any_unit and len(units) != 1:
            raise UsageError("only a single unit can answer under any id", got=f"{len(units)} units")
        for unit_id in units:
            if not 0 <= unit_id <= 255:
                raise UsageError("unit id", expected="0 to 255", got=str(unit_id))
        self.units = dict(units)
        self.max_in_flight = max_in_flight
        self.desync: Desync | None = None
        self.counts = counts or Counts()
        """Requests that reached a unit, and the replies to them."""
        self.requests = 0
        self.discarded = 0
        """ADUs that were dropped: not Modbus, or too short for a function."""
        self._allow = allow
        self._any_unit = any_unit
        self._buffer = bytearray()

    @property
    def pending(self) -> int:
        """Bytes of an ADU that is not whole."""
        return len(self._buffer)

    def feed(self, data: bytes, now_ns: int) -> list[bytes]:
        """Response ADUs to what is whole now, in order. Never raises, whatever comes."""
        return [exchange.reply for exchange in self.receive(data, now_ns) if exchange.reply]

    def receive(self, data: bytes, now_ns: int) -> list[Exchange]:
        """Like `feed`, with every request ADU, for taps and journals."""
        if self.desync is not None:
            return []
        if not self._buffer and _is_adu(data):
            self.requests += 1
            return [self._exchange(data, False, now_ns)]
        self._buffer += data
        exchanges: list[Exchange] = []
        while adu := self._next_adu():
            self.requests += 1
            busy = len(exchanges) >= self.max_in_flight
            exchanges.append(self._exchange(adu, busy, now_ns))
        return exchanges

    def answer(self, data: bytes, now_ns: int) -> bytes:
        """Like `feed`, the responses in one piece. What comes is one whole ADU as a rule: that is not copied together first."""
        if not self._buffer and _is_adu(data):
            if self.desync is not None:
                return b""
            self.requests += 1
            return self._reply(self._route(data[6]), data, False, now_ns)
        return b"".join(self.feed(data, now_ns))

    def receive_datagram(self, data: bytes, now_ns: int) -> list[Exchange]:
        """Like `receive`, for a datagram: what is not whole at its end is dropped, and nothing outlives it."""
        exchanges = self.receive(data, now_ns)
        self.discarded += bool(self._buffer)
        self._buffer.clear()
        self.desync = None
        return exchanges

    def _next_adu(self) -> bytes | None:
        buffer, at, size = self._buffer, 0, len(self._buffer)
        adu = None
        while size - at >= HEADER:
            length = buffer[at + 4] << 8 | buffer[at + 5]
            if length > MAX_LENGTH:
                self.desync = Desync("MBAP length field", expected=f"{MIN_LENGTH} to {MAX_LENGTH}", got=str(length))
                self.discarded += 1
                at = size
                break
            if size - at < HEADER + length:
                break
            begin, at = at, at + HEADER + length
            if length >= MIN_LENGTH and not buffer[begin + 2] and not buffer[begin + 3]:
                adu = bytes(buffer[begin:at])
                break
            self.discarded += 1
        del buffer[:at]  # once: a flood of ADUs that are none is cut through in one go
        return adu

    def _exchange(self, adu: bytes, busy: bool, now_ns: int) -> Exchange:
        unit = self._route(adu[6])
        reply = self._reply(unit, adu, busy, now_ns)
        return Exchange(adu, reply, unit.latency_s if unit is not None and reply else 0.0)

    def _reply(self, unit: ModbusUnit | None, adu: bytes, busy: bool, now_ns: int) -> bytes:
        """The whole response, empty for silence."""
        pdu = adu[7:]
        response: bytes | None
        if unit is None:
            response = bytes((pdu[0] | 0x80, NO_PATH)) if pdu[0] < 0x80 else None
        else:
            unit.counters.bus_messages += 1
            if self._allow is not None and not self._allow(adu[6], pdu):
                response = unit.refuse_function(pdu)
            else:
                response = unit.refuse_busy(pdu) if busy else unit.respond(pdu, now_ns)
            self.counts.requests += 1
            self.counts.replies += response is not None
        if response is None:
            return b""
        return adu[:4] + (len(response) + 1).to_bytes(2, "big") + adu[6:7] + response

    def _route(self, unit_id: int) -> ModbusUnit | None:
        if unit_id in self.units:
            return self.units[unit_id]
        if (self._any_unit or unit_id in ANY_UNIT) and len(self.units) == 1:
            return next(iter(self.units.values()))
        return None


def _is_adu(data: bytes) -> bool:
    """Whether a chunk is one whole ADU of Modbus, and nothing else: as a rule."""
    length = len(data) - HEADER
    return MIN_LENGTH <= length <= MAX_LENGTH and data[5] == length and data[2:5] == b"\0\0\0"
