"""Splits recorded Modbus PDUs into cells, and builds replies from cells.

A cell is one bit or register, given by table and address. Functions 01 to 06, 0F and 10h are processed cell by cell (MODBUS
Application Protocol V1.1b3, 6.1 to 6.12). All other requests are opaque: they are answered as a whole or not at all. This module
performs no I/O, and is independent of the server's decoder in fieldtwin.emulators.modbus and of the client's decoder.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

from fieldtwin.emulators.modbus.bank import Table

_READS: dict[int, tuple[Table, int]] = {
    1: ("coil", 2000),
    2: ("discrete", 2000),
    3: ("holding", 125),
    4: ("input", 125),
}
_COIL_VALUES = {0xFF00: 1, 0x0000: 0}

ILLEGAL_FUNCTION, ILLEGAL_ADDRESS, ILLEGAL_VALUE, DEVICE_FAILURE = 1, 2, 3, 4


@dataclass(frozen=True, slots=True)
class CellRequest:
    """A request for cells of one table. `values` is None for a read, and the values to write for a write."""

    function: int
    table: Table
    address: int
    count: int
    values: tuple[int, ...] | None = None

    @property
    def addresses(self) -> range:
        return range(self.address, self.address + self.count)


def parse_request(pdu: bytes) -> CellRequest | None:
    """Return the cells of a request; None if it is opaque: a different function, or malformed."""
    function = pdu[0] if pdu else 0
    if len(pdu) < 5:
        return None
    address, number = struct.unpack(">HH", pdu[1:5])
    request = None
    if function in _READS and len(pdu) == 5:
        table, most = _READS[function]
        request = CellRequest(function, table, address, number) if 1 <= number <= most else None
    elif function == 5 and len(pdu) == 5 and number in _COIL_VALUES:
        request = CellRequest(function, "coil", address, 1, (_COIL_VALUES[number],))
    elif function == 6 and len(pdu) == 5:
        request = CellRequest(function, "holding", address, 1, (number,))
    elif function in (15, 16):
        request = _parse_write_many(pdu, address, number)
    return request if request and request.addresses.stop <= 0x10000 else None


def leaves_the_table(pdu: bytes) -> bool:
    """Return whether a request is valid except that its last address is outside of the table.

    Such a request gets exception 02, while a bad quantity gets 03 (AP 6).
    """
    if len(pdu) < 5 or pdu[0] not in {*_READS, 15, 16}:
        return False
    address, count = struct.unpack(">HH", pdu[1:5])
    return address + count > 0x10000 and parse_request(pdu[:1] + b"\0\0" + pdu[3:]) is not None


def parse_values(request: CellRequest, reply: bytes) -> tuple[int, ...] | None:
    """Return the cells in a normal reply to a read; None if `reply` is not one."""
    if len(reply) < 2 or reply[0] != request.function or reply[1] != len(reply) - 2:
        return None
    data = reply[2:]
    if request.function <= 2:
        return _bits(data, request.count) if len(data) == (request.count + 7) // 8 else None
    return struct.unpack(f">{request.count}H", data) if len(data) == 2 * request.count else None


def is_exception(request: bytes, reply: bytes) -> bool:
    """Return whether `reply` is an exception response to `request`."""
    return len(reply) == 2 and reply[0] == request[0] | 0x80


def exception(request: bytes, code: int) -> bytes:
    """Return an exception response."""
    return bytes((request[0] | 0x80, code))


def is_written(request: CellRequest, pdu: bytes, reply: bytes) -> bool:
    """Return whether `reply` is the reply to a successful write."""
    return reply == written_reply(request, pdu)


def written_reply(request: CellRequest, pdu: bytes) -> bytes:
    """Return the normal reply to a write: the request itself, or its function, address and count."""
    return pdu if request.function <= 6 else pdu[:5]


def read_reply(request: CellRequest, values: list[int]) -> bytes:
    """Return the normal reply to a read."""
    if request.function <= 2:
        packed = sum(bit << i for i, bit in enumerate(values))
        data = packed.to_bytes((request.count + 7) // 8, "little")
    else:
        data = struct.pack(f">{request.count}H", *values)
    return bytes((request.function, len(data))) + data


def _parse_write_many(pdu: bytes, address: int, count: int) -> CellRequest | None:
    data = pdu[6:]
    if len(pdu) < 6 or pdu[5] != len(data):
        return None
    if pdu[0] == 15 and 1 <= count <= 1968 and len(data) == (count + 7) // 8:
        return CellRequest(15, "coil", address, count, _bits(data, count))
    if pdu[0] == 16 and 1 <= count <= 123 and len(data) == 2 * count:
        return CellRequest(16, "holding", address, count, struct.unpack(f">{count}H", data))
    return None


def _bits(data: bytes, count: int) -> tuple[int, ...]:
    return tuple(data[i // 8] >> i % 8 & 1 for i in range(count))
