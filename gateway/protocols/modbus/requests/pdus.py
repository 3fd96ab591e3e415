"""Encode and decode protocol data units. pymodbus's PDU classes encode the requests.

This is the only file that imports pymodbus. Its decoders are not used: they accept too much (any byte count, any echo,
padding) and take longer than the rest of an exchange (docs/decisions). Errors of its encoders are translated here.
Requests are polled repeatedly, so their bytes are cached, up to a limited number.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from functools import lru_cache
from itertools import chain

from pymodbus.exceptions import ModbusException
from pymodbus.pdu import ModbusPDU
from pymodbus.pdu.bit_message import (
    ReadCoilsRequest,
    ReadDiscreteInputsRequest,
    WriteMultipleCoilsRequest,
    WriteSingleCoilRequest,
)
from pymodbus.pdu.mei_message import ReadDeviceInformationRequest
from pymodbus.pdu.other_message import ReadExceptionStatusRequest, ReportDeviceIdRequest
from pymodbus.pdu.register_message import (
    MaskWriteRegisterRequest,
    ReadHoldingRegistersRequest,
    ReadInputRegistersRequest,
    ReadWriteMultipleRegistersRequest,
    WriteMultipleRegistersRequest,
    WriteSingleRegisterRequest,
)

from fieldtwin.gateway.core.errors import Bug

_FOREIGN = (ModbusException, ValueError, IndexError, TypeError, struct.error)

_READ_REQUESTS: dict[int, type[ModbusPDU]] = {
    0x01: ReadCoilsRequest,
    0x02: ReadDiscreteInputsRequest,
    0x03: ReadHoldingRegistersRequest,
    0x04: ReadInputRegistersRequest,
}

_KEPT = 4096
"""The number of encoded reads that are cached: the different reads in the poll groups of a few hundred devices. It saves
17 % of a read of 10 registers."""

_MOST_WORDS = 126
_WORDS = tuple(struct.Struct(f">{count}H") for count in range(_MOST_WORDS + 1))
_BITS = tuple(tuple(bool(byte >> bit & 1) for bit in range(8)) for byte in range(256))


def _encode(make: Callable[[], ModbusPDU]) -> bytes:
    try:
        pdu = make()
        return bytes([pdu.function_code]) + pdu.encode()
    except _FOREIGN as e:
        raise Bug(f"a checked request cannot be encoded: {type(e).__name__}: {e}") from e


@lru_cache(maxsize=_KEPT)
def encode_read(function: int, address: int, count: int) -> bytes:
    """Encode functions 01h to 04h (AP 6.1 to 6.4)."""
    return _encode(lambda: _READ_REQUESTS[function](address=address, count=count))


def encode_write_coil(address: int, value: bool) -> bytes:
    """Encode function 05h (AP 6.5)."""
    return _encode(lambda: WriteSingleCoilRequest(address=address, bits=[value]))


def encode_write_register(address: int, value: int) -> bytes:
    """Encode function 06h (AP 6.6)."""
    return _encode(lambda: WriteSingleRegisterRequest(address=address, registers=[value]))


def encode_write_coils(address: int, values: Sequence[bool]) -> bytes:
    """Encode function 0Fh (AP 6.11)."""
    return _encode(lambda: WriteMultipleCoilsRequest(address=address, bits=list(values)))


def encode_write_registers(address: int, values: Sequence[int]) -> bytes:
    """Encode function 10h (AP 6.12)."""
    return _encode(lambda: WriteMultipleRegistersRequest(address=address, registers=list(values)))


def encode_mask_write(address: int, and_mask: int, or_mask: int) -> bytes:
    """Encode function 16h (AP 6.16)."""
    return _encode(lambda: MaskWriteRegisterRequest(address=address, and_mask=and_mask, or_mask=or_mask))


def encode_read_write(read_address: int, read_count: int, write_address: int, values: Sequence[int]) -> bytes:
    """Encode function 17h (AP 6.17)."""
    return _encode(
        lambda: ReadWriteMultipleRegistersRequest(
            read_address=read_address,
            read_count=read_count,
            write_address=write_address,
            write_registers=list(values),
        )
    )


def encode_exception_status() -> bytes:
    """Encode function 07h (AP 6.7)."""
    return _encode(ReadExceptionStatusRequest)


def encode_report_server_id() -> bytes:
    """Encode function 11h (AP 6.13)."""
    return _encode(ReportDeviceIdRequest)


def encode_device_identification(read_code: int, object_id: int) -> bytes:
    """Encode function 2Bh with MEI type 0Eh (AP 6.21)."""
    return _encode(lambda: ReadDeviceInformationRequest(read_code=read_code, object_id=object_id))


def words_of(data: bytes) -> tuple[int, ...]:
    """Return the unsigned words of `data`, high byte first (AP 4.2): an even number of bytes, at most 252."""
    return _WORDS[len(data) // 2].unpack(data)


def words_to_bytes(words: Sequence[int]) -> bytes:
    """Return the bytes of at most 126 `words`, each 0 to 65535, high byte first."""
    return _WORDS[len(words)].pack(*words)


def bits_of(data: bytes) -> tuple[bool, ...]:
    """Return the bits of `data`, padding included: the lowest bit of the first byte is the first (AP 6.1)."""
    return tuple(chain.from_iterable(map(_BITS.__getitem__, data)))
