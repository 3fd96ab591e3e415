"""The border to pymodbus: protocol data units in and out by its PDU classes, encode and decode only.

The only file that imports pymodbus. Its decoders accept too much (any byte count, any echo, padding): whoever calls a
``decode_`` function has checked length and byte count against the request before. What they raise nevertheless is
translated here.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

from pymodbus.exceptions import ModbusException
from pymodbus.pdu import ModbusPDU
from pymodbus.pdu.bit_message import (
    ReadCoilsRequest,
    ReadCoilsResponse,
    ReadDiscreteInputsRequest,
    ReadDiscreteInputsResponse,
    WriteMultipleCoilsRequest,
    WriteSingleCoilRequest,
)
from pymodbus.pdu.mei_message import ReadDeviceInformationRequest
from pymodbus.pdu.other_message import ReadExceptionStatusRequest, ReportDeviceIdRequest
from pymodbus.pdu.register_message import (
    MaskWriteRegisterRequest,
    ReadHoldingRegistersRequest,
    ReadHoldingRegistersResponse,
    ReadInputRegistersRequest,
    ReadInputRegistersResponse,
    ReadWriteMultipleRegistersRequest,
    ReadWriteMultipleRegistersResponse,
    WriteMultipleRegistersRequest,
    WriteSingleRegisterRequest,
)

from gateway.core.errors import Bug, Desync, FieldtwinError

_FOREIGN = (ModbusException, ValueError, IndexError, TypeError, struct.error)

_READ_REQUESTS: dict[int, type[ModbusPDU]] = {
    0x01: ReadCoilsRequest,
    0x02: ReadDiscreteInputsRequest,
    0x03: ReadHoldingRegistersRequest,
    0x04: ReadInputRegistersRequest,
}
_REGISTER_REPLIES: dict[int, type[ModbusPDU]] = {
    0x03: ReadHoldingRegistersResponse,
    0x04: ReadInputRegistersResponse,
    0x17: ReadWriteMultipleRegistersResponse,
}
_BIT_REPLIES: dict[int, type[ModbusPDU]] = {0x01: ReadCoilsResponse, 0x02: ReadDiscreteInputsResponse}


@contextmanager
def _translated(make: Callable[[str], FieldtwinError]) -> Iterator[None]:
    try:
        yield
    except _FOREIGN as e:
        raise make(f"{type(e).__name__}: {e}") from e


def _unencodable(why: str) -> FieldtwinError:
    return Bug(f"a checked request cannot be encoded: {why}")


def _undecodable(why: str) -> FieldtwinError:
    return Desync(f"a reply cannot be decoded: {why}")


def _encode(make: Callable[[], ModbusPDU]) -> bytes:
    with _translated(_unencodable):
        pdu = make()
        return bytes([pdu.function_code]) + pdu.encode()


def encode_read(function: int, address: int, count: int) -> bytes:
    """Functions 01h to 04h (AP 6.1 to 6.4)."""
    return _encode(lambda: _READ_REQUESTS[function](address=address, count=count))


def encode_write_coil(address: int, value: bool) -> bytes:
    """Function 05h (AP 6.5)."""
    return _encode(lambda: WriteSingleCoilRequest(address=address, bits=[value]))


def encode_write_register(address: int, value: int) -> bytes:
    """Function 06h (AP 6.6)."""
    return _encode(lambda: WriteSingleRegisterRequest(address=address, registers=[value]))


def encode_write_coils(address: int, values: Sequence[bool]) -> bytes:
    """Function 0Fh (AP 6.11)."""
    return _encode(lambda: WriteMultipleCoilsRequest(address=address, bits=list(values)))


def encode_write_registers(address: int, values: Sequence[int]) -> bytes:
    """Function 10h (AP 6.12)."""
    return _encode(lambda: WriteMultipleRegistersRequest(address=address, registers=list(values)))


def encode_mask_write(address: int, and_mask: int, or_mask: int) -> bytes:
    """Function 16h (AP 6.16)."""
    return _encode(lambda: MaskWriteRegisterRequest(address=address, and_mask=and_mask, or_mask=or_mask))


def encode_read_write(read_address: int, read_count: int, write_address: int, values: Sequence[int]) -> bytes:
    """Function 17h (AP 6.17)."""
    return _encode(
        lambda: ReadWriteMultipleRegistersRequest(
            read_address=read_address,
            read_count=read_count,
            write_address=write_address,
            write_registers=list(values),
        )
    )


def encode_exception_status() -> bytes:
    """Function 07h (AP 6.7)."""
    return _encode(ReadExceptionStatusRequest)


def encode_report_server_id() -> bytes:
    """Function 11h (AP 6.13)."""
    return _encode(ReportDeviceIdRequest)


def encode_device_identification(read_code: int, object_id: int) -> bytes:
    """Function 2Bh with MEI type 0Eh (AP 6.21)."""
    return _encode(lambda: ReadDeviceInformationRequest(read_code=read_code, object_id=object_id))


def decode_registers(pdu: bytes) -> tuple[int, ...]:
    """The registers of a reply to 03h, 04h or 17h whose byte count has been checked."""
    with _translated(_undecodable):
        reply = _REGISTER_REPLIES[pdu[0]]()
        reply.decode(pdu[1:])
        return tuple(reply.registers)


def decode_bits(pdu: bytes) -> tuple[bool, ...]:
    """The bits of a reply to 01h or 02h, padding included, whose byte count has been checked."""
    with _translated(_undecodable):
        reply = _BIT_REPLIES[pdu[0]]()
        reply.decode(pdu[1:])
        return tuple(reply.bits)
