"""One Modbus unit: request PDU in, response PDU out (MODBUS Application Protocol V1.1b3, AP below).

Pure. It never knows unit ids, check sums, transaction ids or what carries it; what the registers mean is the bank's
business. Checks go in the order of the flow charts of AP 6: function (01), quantities and lengths (03), addresses
(02), then execution. A refused request has changed nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from emulators.modbus.bank import (
    ADDRESSES,
    Busy,
    IllegalAddress,
    IllegalFunction,
    IllegalValue,
    Refusal,
    RegisterBank,
    Table,
)
from emulators.modbus.diagnostics import Diagnostics, UnitCounters
from gateway.core.errors import UsageError

ALL_FUNCTIONS = frozenset({0x01, 0x02, 0x03, 0x04, 0x05, 0x06, 0x08, 0x0F, 0x10, 0x11, 0x16, 0x17})
BROADCAST_FUNCTIONS = frozenset({0x05, 0x06, 0x0F, 0x10, 0x16})
"""What may come as a broadcast: writes that ask for no data back (SL 2.4.1)."""

_TABLES: dict[int, Table] = {0x01: "coil", 0x02: "discrete", 0x03: "holding", 0x04: "input"}


@dataclass(frozen=True, slots=True)
class UnitLimits:
    """What a device of this kind supports; the defaults are the protocol's own limits (AP 6).

    `even_only`: values take two registers and half a value is refused: an odd count with 03, an odd address with 02.
    """

    functions: frozenset[int] = ALL_FUNCTIONS
    read_registers: int = 125
    write_registers: int = 123
    read_bits: int = 2000
    write_bits: int = 1968
    even_only: bool = False

    def __post_init__(self) -> None:
        for name, most in (
            ("read_registers", 125),
            ("write_registers", 123),
            ("read_bits", 2000),
            ("write_bits", 1968),
        ):
            if not 1 <= getattr(self, name) <= most:
                raise UsageError(f"limit {name}", expected=f"1 to {most}", got=str(getattr(self, name)))
        if not self.functions <= ALL_FUNCTIONS:
            unknown = sorted(self.functions - ALL_FUNCTIONS)
            raise UsageError("a function that emulated units do not have", got=", ".join(f"{f:02X}h" for f in unknown))


class ModbusUnit:
    """A unit's functions over a bank. `server_id` is the data of function 11h; None: the unit has no such function.

    Use `respond` for a request to the unit, `execute_broadcast` for one to unit 0 of a serial line. `counters` grow
    with both; a line tells by `heard` what else went over it.
    """

    def __init__(
        self, bank: RegisterBank, limits: UnitLimits | None = None, server_id: bytes | None = None, name: str = ""
    ) -> None:
        if server_id is not None and len(server_id) > 249:
            raise UsageError("server id", expected="at most 249 bytes", got=str(len(server_id)))
        self.bank = bank
        self.limits = limits or UnitLimits()
        self.name = name
        self.counters = UnitCounters()
        self.diagnostics = Diagnostics(self.counters)
        self._server_id = server_id
        self._functions = self.limits.functions - (frozenset() if server_id is not None else {0x11})
        read: Callable[[bytes, int], bytes | None] = self._read
        self._handlers: dict[int, Callable[[bytes, int], bytes | None]] = {
            **dict.fromkeys(_TABLES, read),
            0x05: self._write_coil,
            0x06: self._write_register,
            0x08: lambda pdu, now_ns: self.diagnostics.respond(pdu),
            0x0F: self._write_coils,
            0x10: self._write_registers,
            0x11: self._report_server_id,
            0x16: self._mask_write,
            0x17: self._read_write,
        }

    def respond(self, pdu: bytes, now_ns: int) -> bytes | None:
        """Execute a request to this unit and return its response, exception responses included.

        None: no answer. That is so in listen-only mode, for the request that starts or ends it, for an empty PDU, and for
        function codes from 80h: they are exception responses by AP 4.1, and an answer to an answer may never end.
        """
        return self._counted(pdu, now_ns, busy=False)

    def refuse_busy(self, pdu: bytes) -> bytes | None:
        """Like `respond`, for a request that comes while too many are under way: exception 06, nothing executed."""
        return self._counted(pdu, 0, busy=True)

    def execute_broadcast(self, pdu: bytes, now_ns: int) -> None:
        """Execute a request to unit 0 and say nothing; reads and refused writes have no effect."""
        self.counters.broadcasts += 1
        self.counters.unanswered += 1
        if self.diagnostics.listen_only or not pdu or pdu[0] not in BROADCAST_FUNCTIONS & self._functions:
            return
        try:
            self._handlers[pdu[0]](pdu, now_ns)
        except Refusal:
            pass  # nobody is answered, nothing was changed: SL 2.4.1

    def heard(self, messages: int = 0, errors: int = 0) -> None:
        """The line carried so many whole and damaged frames, for whomever."""
        self.counters.bus_messages += messages
        self.counters.bus_errors += errors

    def _counted(self, pdu: bytes, now_ns: int, busy: bool) -> bytes | None:
        self.counters.requests += 1  # first: a request for the counters counts itself
        response = self._answer(pdu, now_ns, busy)
        if response is None:
            self.counters.unanswered += 1
        else:
            self.counters.replies += 1
        return response

    def _answer(self, pdu: bytes, now_ns: int, busy: bool) -> bytes | None:
        if not pdu or pdu[0] >= 0x80:
            return None
        if self.diagnostics.listen_only:
            self.diagnostics.wakes(pdu)
            return None
        try:
            if busy:
                raise Busy("too many requests under way")
            if pdu[0] not in self._functions:
                raise IllegalFunction(f"function {pdu[0]:02X}h")
            return self._handlers[pdu[0]](pdu, now_ns)
        except Refusal as refusal:
            self.counters.exceptions += 1
            self.counters.busy += isinstance(refusal, Busy)
            return bytes((pdu[0] | 0x80, refusal.code))

    # -- functions, AP 6.1 to 6.17 --------------------------------------------------------------------------------

    def _read(self, pdu: bytes, now_ns: int) -> bytes:
        table = _TABLES[pdu[0]]
        _require_length(pdu, 5)
        address, count = _words(pdu[1:5])
        if pdu[0] <= 0x02:
            _require_count(count, self.limits.read_bits)
            _require_range(address, count)
            data = _pack_bits(self.bank.read(table, address, count, now_ns))
        else:
            self._require_registers(address, count, self.limits.read_registers)
            data = _pack_words(self.bank.read(table, address, count, now_ns))
        return bytes((pdu[0], len(data))) + data

    def _write_coil(self, pdu: bytes, now_ns: int) -> bytes:
        _require_length(pdu, 5)
        address, value = _words(pdu[1:5])
        if value not in (0x0000, 0xFF00):
            raise IllegalValue("coil value", expected="0000h or FF00h", got=f"{value:04X}h")
        self.bank.write("coil", address, [value >> 15], now_ns)
        return pdu

    def _write_register(self, pdu: bytes, now_ns: int) -> bytes:
        _require_length(pdu, 5)
        address, value = _words(pdu[1:5])
        self._require_registers(address, 1, 1)
        self.bank.write("holding", address, [value], now_ns)
        return pdu

    def _write_coils(self, pdu: bytes, now_ns: int) -> bytes:
        address, count, data = _block(pdu, 1)
        _require_count(count, self.limits.write_bits)
        if len(data) != (count + 7) // 8:
            raise IllegalValue("byte count", expected=str((count + 7) // 8), got=str(len(data)))
        _require_range(address, count)
        self.bank.write("coil", address, [data[i // 8] >> i % 8 & 1 for i in range(count)], now_ns)
        return pdu[:5]

    def _write_registers(self, pdu: bytes, now_ns: int) -> bytes:
        address, count, data = _block(pdu, 1)
        _require_words(data, count)
        self._require_registers(address, count, self.limits.write_registers)
        self.bank.write("holding", address, _words(data), now_ns)
        return pdu[:5]

    def _report_server_id(self, pdu: bytes, now_ns: int) -> bytes:
        _require_length(pdu, 1)
        data = (self._server_id or b"") + b"\xff"  # run indicator: on (AP 6.13)
        return bytes((pdu[0], len(data))) + data

    def _mask_write(self, pdu: bytes, now_ns: int) -> bytes:
        _require_length(pdu, 7)
        address, keep, put = _words(pdu[1:7])
        self._require_registers(address, 1, 1)
        (current,) = self.bank.read("holding", address, 1, now_ns)
        self.bank.write("holding", address, [(current & keep) | (put & ~keep & 0xFFFF)], now_ns)
        return pdu

    def _read_write(self, pdu: bytes, now_ns: int) -> bytes:
        if len(pdu) < 10:
            raise IllegalValue("request is too short", got=f"{len(pdu)} bytes")
        read_address, read_count = _words(pdu[1:5])
        write_address, write_count, data = _block(pdu, 5)
        _require_count(read_count, self.limits.read_registers)
        # AP 6.17 allows 121 registers to be written here, two fewer than function 10h
        _require_count(write_count, min(self.limits.write_registers, 121))
        _require_words(data, write_count)
        self._require_registers(read_address, read_count, self.limits.read_registers)
        self._require_registers(write_address, write_count, self.limits.write_registers)
        self.bank.check_read("holding", read_address, read_count, now_ns)  # refused as a whole, before the write
        self.bank.write("holding", write_address, _words(data), now_ns)
        values = _pack_words(self.bank.read("holding", read_address, read_count, now_ns))
        return bytes((pdu[0], len(values))) + values

    def _require_registers(self, address: int, count: int, most: int) -> None:
        """03 before 02. A single write (most == 1) of half a value is the device's own affair."""
        _require_count(count, most)
        pairs = self.limits.even_only and most > 1
        if pairs and count % 2:
            raise IllegalValue("half a value", expected="an even count", got=str(count))
        _require_range(address, count)
        if pairs and address % 2:
            raise IllegalAddress("half a value", expected="an even address", got=str(address))


def _words(data: bytes) -> list[int]:
    return [data[i] << 8 | data[i + 1] for i in range(0, len(data), 2)]


def _pack_words(values: Sequence[int]) -> bytes:
    return b"".join(value.to_bytes(2, "big") for value in values)


def _pack_bits(values: Sequence[int]) -> bytes:
    """First bit in the lowest place of the first byte, the last byte filled up with zeros (AP 6.1)."""
    data = bytearray((len(values) + 7) // 8)
    for i, value in enumerate(values):
        data[i // 8] |= bool(value) << i % 8
    return bytes(data)


def _block(pdu: bytes, at: int) -> tuple[int, int, bytes]:
    """Address, count and data of a write of several cells; the byte count must be that of the data (row MB-040)."""
    if len(pdu) < at + 5 or pdu[at + 4] != len(pdu) - at - 5:
        raise IllegalValue("byte count and length differ", got=f"{len(pdu)} bytes")
    address, count = _words(pdu[at : at + 4])
    return address, count, pdu[at + 5 :]


def _require_length(pdu: bytes, length: int) -> None:
    if len(pdu) != length:
        raise IllegalValue("length of the request", expected=f"{length} bytes", got=str(len(pdu)))


def _require_count(count: int, most: int) -> None:
    if not 1 <= count <= most:
        raise IllegalValue("quantity", expected=f"1 to {most}", got=str(count))


def _require_words(data: bytes, count: int) -> None:
    if len(data) != 2 * count:
        raise IllegalValue("byte count", expected=str(2 * count), got=str(len(data)))


def _require_range(address: int, count: int) -> None:
    if address + count > ADDRESSES:
        raise IllegalAddress("beyond the end of the table", got=f"{count} from {address}")
