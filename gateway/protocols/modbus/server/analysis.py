"""Analyse requests to the gateway's own servers: function, addresses, and whether the request changes anything.

Only the request PDU is used (AP 6), not its sender and no register values. Quantities (exception 03) are checked before addresses
(02) (case MB-038). A request that passes can be sent to a unit, checked against an allow-list, or answered. This module shares no
code with the emulators' server.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from fieldtwin.gateway.core.errors import ModbusExceptionReply
from fieldtwin.gateway.protocols.modbus.requests.refusals import refusal

ServedTable = Literal["coil", "discrete", "input", "holding"]

ILLEGAL_FUNCTION = 0x01
ILLEGAL_ADDRESS = 0x02
ILLEGAL_VALUE = 0x03
SERVER_FAILURE = 0x04
SERVER_BUSY = 0x06
NO_PATH = 0x0A
NO_RESPONSE = 0x0B

READ_FUNCTIONS = frozenset({0x01, 0x02, 0x03, 0x04, 0x07, 0x0B, 0x0C, 0x11, 0x14, 0x18, 0x2B})
"""Functions that do not change a unit. Function 2Bh belongs to them only as device identification (0Eh): see
`ServerRequest.changes`.
"""

WRITE_FUNCTIONS = frozenset({0x05, 0x06, 0x0F, 0x10, 0x15, 0x16, 0x17})

BROADCAST_FUNCTIONS = frozenset({0x05, 0x06, 0x0F, 0x10, 0x15, 0x16})
"""Functions that may be broadcast: writes that ask for no data (SL 2.1)."""

_HARMLESS_DIAGNOSTICS = frozenset({0x00, 0x02, *range(0x0B, 0x13)})
"""Sub-functions of 08h that only report: echo, the diagnostic register, and the counters (AP 6.8)."""

_IDENTIFICATION = 0x0E


@dataclass(frozen=True, slots=True)
class Access:
    """`count` registers or bits of `table` from PDU address `address`."""

    table: ServedTable
    address: int
    count: int
    write: bool = False


@dataclass(frozen=True, slots=True)
class ServerRequest:
    """A well-formed request. `reply_bytes` is the size of its normal reply PDU, or 0 if the request does not determine it.

    `changes` says whether it may change the unit; it is true for every unknown function. `accesses` are in the order in
    which the unit performs them.
    """

    function: int
    changes: bool
    accesses: tuple[Access, ...] = ()
    reply_bytes: int = 0


def exception_pdu(error: ModbusExceptionReply) -> bytes:
    """Return the exception response for `error` (AP 7)."""
    return bytes([error.function & 0x7F | 0x80, error.code])


def examine(pdu: bytes) -> ServerRequest:
    """Read a request PDU. Raises `ModbusExceptionReply` with the code that the server has to answer: 01, 02 or 03.

    A function code of 0, or from 80h on, is always refused with 01, one of the reactions that case MB-035 permits.
    """
    if not pdu or not 1 <= pdu[0] <= 0x7F:
        raise refusal(pdu[0] if pdu else 0, ILLEGAL_FUNCTION)
    reader = _READERS.get(pdu[0])
    return ServerRequest(pdu[0], changes=True) if reader is None else reader(pdu)


def changes_a_unit(pdu: bytes) -> bool:
    """Return whether a request may change the unit. For a request with a wrong length, only its function code is considered."""
    try:
        return examine(pdu).changes
    except ModbusExceptionReply:
        return pdu[:1] != b"" and pdu[0] in WRITE_FUNCTIONS


def word(pdu: bytes, at: int) -> int:
    """Return the unsigned word at byte `at`, high byte first (AP 4.2)."""
    return pdu[at] << 8 | pdu[at + 1]


def _require(pdu: bytes, well_formed: bool) -> None:
    if not well_formed:
        raise refusal(pdu[0], ILLEGAL_VALUE)


def _access(pdu: bytes, table: ServedTable, address: int, count: int, most: int, *, write: bool = False) -> Access:
    _require(pdu, 1 <= count <= most)
    return Access(table, address, count, write)


def _addressed(pdu: bytes, *accesses: Access) -> tuple[Access, ...]:
    """Return the accesses if none of them leaves the address space (case MB-037)."""
    if any(a.address + a.count > 0x10000 for a in accesses):
        raise refusal(pdu[0], ILLEGAL_ADDRESS)
    return accesses


def _read_bits(pdu: bytes) -> ServerRequest:
    _require(pdu, len(pdu) == 5)
    count = word(pdu, 3)
    access = _access(pdu, "coil" if pdu[0] == 0x01 else "discrete", word(pdu, 1), count, 2000)
    return ServerRequest(pdu[0], False, _addressed(pdu, access), 2 + (count + 7) // 8)


def _read_registers(pdu: bytes) -> ServerRequest:
    _require(pdu, len(pdu) == 5)
    count = word(pdu, 3)
    access = _access(pdu, "holding" if pdu[0] == 0x03 else "input", word(pdu, 1), count, 125)
    return ServerRequest(pdu[0], False, _addressed(pdu, access), 2 + 2 * count)


def _write_single(pdu: bytes) -> ServerRequest:
    coil = pdu[0] == 0x05
    _require(pdu, len(pdu) == 5 and (not coil or pdu[3:] in (b"\x00\x00", b"\xff\x00")))
    return ServerRequest(pdu[0], True, (Access("coil" if coil else "holding", word(pdu, 1), 1, True),), 5)


def _write_coils(pdu: bytes) -> ServerRequest:
    _require(pdu, len(pdu) >= 6)
    count = word(pdu, 3)
    access = _access(pdu, "coil", word(pdu, 1), count, 1968, write=True)
    _require(pdu, pdu[5] == (count + 7) // 8 and len(pdu) == 6 + pdu[5])
    return ServerRequest(pdu[0], True, _addressed(pdu, access), 5)


def _write_registers(pdu: bytes) -> ServerRequest:
    _require(pdu, len(pdu) >= 6)
    count = word(pdu, 3)
    access = _access(pdu, "holding", word(pdu, 1), count, 123, write=True)
    _require(pdu, pdu[5] == 2 * count and len(pdu) == 6 + pdu[5])
    return ServerRequest(pdu[0], True, _addressed(pdu, access), 5)


def _mask_write(pdu: bytes) -> ServerRequest:
    _require(pdu, len(pdu) == 7)
    return ServerRequest(pdu[0], True, (Access("holding", word(pdu, 1), 1, True),), 7)


def _read_write(pdu: bytes) -> ServerRequest:
    _require(pdu, len(pdu) >= 10)
    read = _access(pdu, "holding", word(pdu, 1), word(pdu, 3), 125)
    written = _access(pdu, "holding", word(pdu, 5), word(pdu, 7), 121, write=True)
    _require(pdu, pdu[9] == 2 * written.count and len(pdu) == 10 + pdu[9])
    return ServerRequest(pdu[0], True, _addressed(pdu, written, read), 2 + 2 * read.count)  # write before read: MB-042


def _fifo(pdu: bytes) -> ServerRequest:
    _require(pdu, len(pdu) == 3)
    return ServerRequest(pdu[0], False, (Access("holding", word(pdu, 1), 1),))


def _diagnostics(pdu: bytes) -> ServerRequest:
    _require(pdu, len(pdu) >= 5 and len(pdu) % 2 == 1)
    return ServerRequest(pdu[0], word(pdu, 1) not in _HARMLESS_DIAGNOSTICS, (), len(pdu))


def _file_records(pdu: bytes) -> ServerRequest:
    _require(pdu, len(pdu) >= 9 and len(pdu) == 2 + pdu[1])
    writes = pdu[0] == 0x15
    _require(pdu, writes or pdu[1] % 7 == 0)
    return ServerRequest(pdu[0], writes, (), len(pdu) if writes else 0)


def _encapsulated(pdu: bytes) -> ServerRequest:
    _require(pdu, len(pdu) >= 2)
    if pdu[1] != _IDENTIFICATION:  # CANopen and others in a Modbus frame may change the unit
        return ServerRequest(pdu[0], True)
    _require(pdu, len(pdu) == 4)
    return ServerRequest(pdu[0], False)


def _bare(reply_bytes: int) -> Callable[[bytes], ServerRequest]:
    def read(pdu: bytes) -> ServerRequest:
        _require(pdu, len(pdu) == 1)
        return ServerRequest(pdu[0], False, (), reply_bytes)

    return read


_READERS: dict[int, Callable[[bytes], ServerRequest]] = {
    0x01: _read_bits,
    0x02: _read_bits,
    0x03: _read_registers,
    0x04: _read_registers,
    0x05: _write_single,
    0x06: _write_single,
    0x07: _bare(2),
    0x08: _diagnostics,
    0x0B: _bare(5),
    0x0C: _bare(0),
    0x0F: _write_coils,
    0x10: _write_registers,
    0x11: _bare(0),
    0x14: _file_records,
    0x15: _file_records,
    0x16: _mask_write,
    0x17: _read_write,
    0x18: _fifo,
    0x2B: _encapsulated,
}
