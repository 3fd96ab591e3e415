"""The functions that access cells: 01 to 06, 0F, 10, 16 and 17h on a bank (AP 6.1 to 6.6, 6.11, 6.12, 6.16, 6.17).

No I/O: a function takes a request PDU and returns a response PDU, or raises a `Refusal`. The checks follow the flow
charts of AP 6: quantities and lengths (03), addresses (02), then execution. A refused request changes nothing.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass

from fieldtwin.emulators.modbus.bank import ADDRESSES, IllegalValue, NoSuchAddress, RegisterBank, Table
from fieldtwin.gateway.core.errors import UsageError

STANDARD_FUNCTIONS = frozenset({*range(0x01, 0x09), 0x0B, 0x0C, 0x0F, 0x10, 0x11, 0x14, 0x15, 0x16, 0x17, 0x18, 0x2B})

TABLES: dict[int, Table] = {0x01: "coil", 0x02: "discrete", 0x03: "holding", 0x04: "input"}
"""By function code of a read: the table that it reads."""


@dataclass(frozen=True, slots=True)
class UnitLimits:
    """The functions and quantities that a device supports; the defaults are the protocol's own limits (AP 6).

    A function in `functions` for which a unit has no data (files, queues, identification, user-defined functions) is
    still answered with 01. `even_only`: values take two registers, and access to half a value is refused: an odd count
    with 03, an odd address with 02.
    """

    functions: frozenset[int] = STANDARD_FUNCTIONS
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
        no_function = sorted(f for f in self.functions if not 1 <= f <= 0x7F)
        if no_function:
            raise UsageError(
                "function codes of a device",
                expected="1 to 127; device-specific functions are registered with the unit",
                got=", ".join(f"{f:02X}h" for f in no_function),
            )


_ADDRESS_AND_COUNT = struct.Struct(">HH").unpack_from
_READ_REPLIES = tuple(struct.Struct(f">BB{count}H").pack for count in range(126))
"""Packers by the number of registers: function code, byte count and registers as they are sent."""


class RegisterFunctions:
    """The functions on one bank, within the limits of one device."""

    def __init__(self, bank: RegisterBank, limits: UnitLimits) -> None:
        self.bank = bank
        self.limits = limits

    def read(self, pdu: bytes, now_ns: int) -> bytes:
        function, limits = pdu[0], self.limits
        require_length(pdu, 5)
        address, count = _ADDRESS_AND_COUNT(pdu, 1)
        if function <= 0x02:
            _require_count(count, limits.read_bits)
            _require_range(address, count)
            data = _pack_bits(self.bank.read(TABLES[function], address, count, now_ns))
            return bytes((function, len(data))) + data
        self._require_registers(address, count, limits.read_registers)
        reply: bytes = _READ_REPLIES[count](
            function, 2 * count, *self.bank.read(TABLES[function], address, count, now_ns)
        )
        return reply

    def write_coil(self, pdu: bytes, now_ns: int) -> bytes:
        require_length(pdu, 5)
        address, value = _words(pdu[1:5])
        if value not in (0x0000, 0xFF00):
            raise IllegalValue("coil value", expected="0000h or FF00h", got=f"{value:04X}h")
        self.bank.write("coil", address, [value >> 15], now_ns)
        return pdu

    def write_register(self, pdu: bytes, now_ns: int) -> bytes:
        require_length(pdu, 5)
        address, value = _words(pdu[1:5])
        self._require_registers(address, 1, 1)
        self.bank.write("holding", address, [value], now_ns)
        return pdu

    def write_coils(self, pdu: bytes, now_ns: int) -> bytes:
        address, count, data = _block(pdu, 1)
        _require_count(count, self.limits.write_bits)
        if len(data) != (count + 7) // 8:
            raise IllegalValue("byte count", expected=str((count + 7) // 8), got=str(len(data)))
        _require_range(address, count)
        self.bank.write("coil", address, [data[i // 8] >> i % 8 & 1 for i in range(count)], now_ns)
        return pdu[:5]

    def write_registers(self, pdu: bytes, now_ns: int) -> bytes:
        address, count, data = _block(pdu, 1)
        _require_words(data, count)
        self._require_registers(address, count, self.limits.write_registers)
        self.bank.write("holding", address, _words(data), now_ns)
        return pdu[:5]

    def mask_write(self, pdu: bytes, now_ns: int) -> bytes:
        require_length(pdu, 7)
        address, keep, put = _words(pdu[1:7])
        self._require_registers(address, 1, 1)
        (current,) = self.bank.read("holding", address, 1, now_ns)
        self.bank.write("holding", address, [(current & keep) | (put & ~keep & 0xFFFF)], now_ns)
        return pdu

    def read_write(self, pdu: bytes, now_ns: int) -> bytes:
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
        """Check the count (03) before the address (02).

        A write of a single register (most == 1) that is half of a value is not refused here: the device decides.
        """
        _require_count(count, most)
        pairs = self.limits.even_only and most > 1
        if pairs and count % 2:
            raise IllegalValue("half a value", expected="an even count", got=str(count))
        _require_range(address, count)
        if pairs and address % 2:
            raise NoSuchAddress("half a value", expected="an even address", got=str(address))


def _words(data: bytes) -> list[int]:
    return list(struct.unpack(f">{len(data) // 2}H", data))


def _pack_words(values: Sequence[int]) -> bytes:
    return struct.pack(f">{len(values)}H", *values)


def _pack_bits(values: Sequence[int]) -> bytes:
    """Pack bits: the first bit is the lowest of the first byte, and the last byte is padded with zeros (AP 6.1)."""
    data = bytearray((len(values) + 7) // 8)
    for i, value in enumerate(values):
        data[i // 8] |= bool(value) << i % 8
    return bytes(data)


def _block(pdu: bytes, at: int) -> tuple[int, int, bytes]:
    """Return address, count and data of a write of several cells. The byte count must match the data (row MB-040)."""
    if len(pdu) < at + 5 or pdu[at + 4] != len(pdu) - at - 5:
        raise IllegalValue("byte count and length differ", got=f"{len(pdu)} bytes")
    address, count = _words(pdu[at : at + 4])
    return address, count, pdu[at + 5 :]


def require_length(pdu: bytes, length: int) -> None:
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
        raise NoSuchAddress("after the end of the table", got=f"{count} from {address}")
