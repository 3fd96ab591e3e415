"""The data requests: coils, discrete inputs and registers (AP 6.1 to 6.6, 6.11, 6.12, 6.16, 6.17).

Addresses are those of the PDU, 0 to 65535 (not 40001). Limits are those of the standard; the limits of a device are in its
profile.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from fieldtwin.gateway.core.errors import UsageError, VerifyFailed
from fieldtwin.gateway.protocols.modbus.requests import pdus
from fieldtwin.gateway.protocols.modbus.requests.replies import BitsReply, RegistersReply, WriteReply
from fieldtwin.gateway.protocols.modbus.requests.request import IMPOSSIBLE, NEED_MORE, Request

RegisterTable = Literal["holding", "input"]
BitTable = Literal["coil", "discrete"]

MAX_READ_REGISTERS = 125
MAX_WRITE_REGISTERS = 123
MAX_READ_WRITE_REGISTERS = 121
MAX_READ_BITS = 2000
MAX_WRITE_BITS = 1968

_REGISTER_FUNCTIONS: dict[str, int] = {"holding": 0x03, "input": 0x04}
_BIT_FUNCTIONS: dict[str, int] = {"coil": 0x01, "discrete": 0x02}


def check_range(what: str, value: int, low: int, high: int) -> None:
    """Raise `UsageError` unless `low` <= `value` <= `high`."""
    if not low <= value <= high:
        raise UsageError(f"{what} out of range", expected=f"{low} to {high}", got=str(value))


def _check_span(address: int, count: int, most: int) -> None:
    check_range("address", address, 0, 0xFFFF)
    check_range("count", count, 1, most)
    check_range("last address", address + count - 1, 0, 0xFFFF)


def _check_table(table: str, known: dict[str, int]) -> None:
    if table not in known:
        raise UsageError("no such table", expected=" or ".join(known), got=repr(table))


def _counted(head: bytes, byte_count: int) -> int:
    """Return the length of the reply PDU that begins with `head`, see `Request.reply_length`; its byte count must be
    `byte_count`.
    """
    if len(head) < 2:
        return NEED_MORE
    return 2 + byte_count if head[1] == byte_count else IMPOSSIBLE


@dataclass(frozen=True, slots=True)
class ReadRegisters(Request[RegistersReply]):
    """Functions 03h and 04h: read 1 to 125 holding or input registers."""

    table: RegisterTable
    address: int
    count: int
    # computed once, because every reply is compared with it
    function: int = field(init=False, repr=False, compare=False)
    _reply_bytes: int = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        _check_table(self.table, _REGISTER_FUNCTIONS)
        _check_span(self.address, self.count, MAX_READ_REGISTERS)
        object.__setattr__(self, "function", _REGISTER_FUNCTIONS[self.table])
        object.__setattr__(self, "_reply_bytes", 2 * self.count)

    def encode(self) -> bytes:
        return pdus.encode_read(self.function, self.address, self.count)

    def nominal_length(self) -> int:
        return 2 + self._reply_bytes

    def reply_length(self, head: bytes) -> int:
        if len(head) < 2:
            return NEED_MORE
        return 2 + self._reply_bytes if head[1] == self._reply_bytes else IMPOSSIBLE

    def decode(self, pdu: bytes, t_ns: int) -> RegistersReply:
        return RegistersReply(pdu[2:], t_ns)


@dataclass(frozen=True, slots=True)
class ReadBits(Request[BitsReply]):
    """Functions 01h and 02h: read 1 to 2000 coils or discrete inputs."""

    table: BitTable
    address: int
    count: int

    def __post_init__(self) -> None:
        _check_table(self.table, _BIT_FUNCTIONS)
        _check_span(self.address, self.count, MAX_READ_BITS)

    @property
    def function(self) -> int:
        return _BIT_FUNCTIONS[self.table]

    def encode(self) -> bytes:
        return pdus.encode_read(self.function, self.address, self.count)

    def nominal_length(self) -> int:
        return 2 + (self.count + 7) // 8

    def reply_length(self, head: bytes) -> int:
        return _counted(head, (self.count + 7) // 8)

    def decode(self, pdu: bytes, t_ns: int) -> BitsReply:
        raw = pdu[2:]
        return BitsReply(pdus.bits_of(raw)[: self.count], raw, t_ns)


class _Write(Request[WriteReply]):
    """A write. Its reply repeats the beginning of the request, and all repeated bytes are verified (case MB-019)."""

    __slots__ = ()
    _ECHOED = 5

    def nominal_length(self) -> int:
        return self._ECHOED

    def reply_length(self, head: bytes) -> int:
        return self._ECHOED

    def decode(self, pdu: bytes, t_ns: int) -> WriteReply:
        expected = self.encode()[: self._ECHOED]
        if pdu != expected:
            raise VerifyFailed(
                f"the acknowledgement of function {self.function:02X}h differs from the request",
                expected=expected[1:].hex(" "),
                got=bytes(pdu[1:]).hex(" "),
            )
        return WriteReply(bytes(pdu[1:]), t_ns)

    def unanswered(self, t_ns: int) -> WriteReply:
        return WriteReply(b"", t_ns, acknowledged=False)


@dataclass(frozen=True, slots=True)
class WriteCoil(_Write):
    """Function 05h: write one coil."""

    address: int
    value: bool

    def __post_init__(self) -> None:
        _check_span(self.address, 1, 1)

    @property
    def function(self) -> int:
        return 0x05

    def encode(self) -> bytes:
        return pdus.encode_write_coil(self.address, self.value)


@dataclass(frozen=True, slots=True)
class WriteRegister(_Write):
    """Function 06h: write one holding register."""

    address: int
    value: int

    def __post_init__(self) -> None:
        _check_span(self.address, 1, 1)
        check_range("register value", self.value, 0, 0xFFFF)

    @property
    def function(self) -> int:
        return 0x06

    def encode(self) -> bytes:
        return pdus.encode_write_register(self.address, self.value)


@dataclass(frozen=True, slots=True)
class WriteCoils(_Write):
    """Function 0Fh: write 1 to 1968 coils."""

    address: int
    values: tuple[bool, ...]

    def __post_init__(self) -> None:
        _check_span(self.address, len(self.values), MAX_WRITE_BITS)

    @property
    def function(self) -> int:
        return 0x0F

    def encode(self) -> bytes:
        return pdus.encode_write_coils(self.address, self.values)


@dataclass(frozen=True, slots=True)
class WriteRegisters(_Write):
    """Function 10h: write 1 to 123 holding registers together or not at all."""

    address: int
    values: tuple[int, ...]

    def __post_init__(self) -> None:
        _check_span(self.address, len(self.values), MAX_WRITE_REGISTERS)
        for value in self.values:
            check_range("register value", value, 0, 0xFFFF)

    @property
    def function(self) -> int:
        return 0x10

    def encode(self) -> bytes:
        return pdus.encode_write_registers(self.address, self.values)


@dataclass(frozen=True, slots=True)
class MaskWriteRegister(_Write):
    """Function 16h: change single bits of a holding register. It becomes (register AND `and_mask`) OR (`or_mask` AND NOT
    `and_mask`).
    """

    address: int
    and_mask: int
    or_mask: int

    _ECHOED = 7

    def __post_init__(self) -> None:
        _check_span(self.address, 1, 1)
        check_range("AND mask", self.and_mask, 0, 0xFFFF)
        check_range("OR mask", self.or_mask, 0, 0xFFFF)

    @property
    def function(self) -> int:
        return 0x16

    def encode(self) -> bytes:
        return pdus.encode_mask_write(self.address, self.and_mask, self.or_mask)


@dataclass(frozen=True, slots=True)
class ReadWriteRegisters(Request[RegistersReply]):
    """Function 17h: write 1 to 121 holding registers, then read 1 to 125, in one transaction."""

    read_address: int
    read_count: int
    write_address: int
    values: tuple[int, ...]

    def __post_init__(self) -> None:
        _check_span(self.read_address, self.read_count, MAX_READ_REGISTERS)
        _check_span(self.write_address, len(self.values), MAX_READ_WRITE_REGISTERS)
        for value in self.values:
            check_range("register value", value, 0, 0xFFFF)

    @property
    def function(self) -> int:
        return 0x17

    def encode(self) -> bytes:
        return pdus.encode_read_write(self.read_address, self.read_count, self.write_address, self.values)

    def nominal_length(self) -> int:
        return 2 + 2 * self.read_count

    def reply_length(self, head: bytes) -> int:
        return _counted(head, 2 * self.read_count)

    def decode(self, pdu: bytes, t_ns: int) -> RegistersReply:
        raw = pdu[2:]
        return RegistersReply(raw, t_ns)
