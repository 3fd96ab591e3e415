"""The requests for information about a device: 07h, 11h and 2Bh/0Eh (AP 6.7, 6.13, 6.21)."""

from __future__ import annotations

from dataclasses import dataclass

from fieldtwin.gateway.core.errors import Desync
from fieldtwin.gateway.protocols.modbus.requests import pdus
from fieldtwin.gateway.protocols.modbus.requests.data import check_range
from fieldtwin.gateway.protocols.modbus.requests.replies import (
    DeviceIdentificationReply,
    ExceptionStatusReply,
    ServerIdReply,
)
from fieldtwin.gateway.protocols.modbus.requests.request import IMPOSSIBLE, MAX_PDU, NEED_MORE, Request, short_hex

_MEI_DEVICE_IDENTIFICATION = 0x0E
_IDENTIFICATION_HEAD = 7  # function, MEI type, read code, conformity, more follows, next object id, number of objects


@dataclass(frozen=True, slots=True)
class ReadExceptionStatus(Request[ExceptionStatusReply]):
    """Function 07h: read the eight exception status outputs. For serial lines only."""

    @property
    def function(self) -> int:
        return 0x07

    def encode(self) -> bytes:
        return pdus.encode_exception_status()

    def nominal_length(self) -> int:
        return 2

    def reply_length(self, head: bytes) -> int:
        return 2

    def decode(self, pdu: bytes, t_ns: int) -> ExceptionStatusReply:
        return ExceptionStatusReply(pdu[1], bytes(pdu[1:]), t_ns)


@dataclass(frozen=True, slots=True)
class ReportServerId(Request[ServerIdReply]):
    """Function 11h: read the server ID. For serial lines only."""

    @property
    def function(self) -> int:
        return 0x11

    def encode(self) -> bytes:
        return pdus.encode_report_server_id()

    def reply_length(self, head: bytes) -> int:
        if len(head) < 2:
            return NEED_MORE
        return 2 + head[1] if 2 + head[1] <= MAX_PDU else IMPOSSIBLE

    def decode(self, pdu: bytes, t_ns: int) -> ServerIdReply:
        return ServerIdReply(bytes(pdu[2:]), t_ns)


@dataclass(frozen=True, slots=True)
class ReadDeviceIdentification(Request[DeviceIdentificationReply]):
    """Function 2Bh/0Eh: one request of a series. `read_code` is 1 (basic), 2 (regular), 3 (extended) or 4 (only `object_id`)."""

    read_code: int = 1
    object_id: int = 0

    def __post_init__(self) -> None:
        check_range("read device id code", self.read_code, 1, 4)
        check_range("object id", self.object_id, 0, 0xFF)

    @property
    def function(self) -> int:
        return 0x2B

    def encode(self) -> bytes:
        return pdus.encode_device_identification(self.read_code, self.object_id)

    def reply_length(self, head: bytes) -> int:
        if len(head) >= 3 and (head[1], head[2]) != (_MEI_DEVICE_IDENTIFICATION, self.read_code):
            return IMPOSSIBLE
        if len(head) < _IDENTIFICATION_HEAD:
            return NEED_MORE
        end = _IDENTIFICATION_HEAD
        for _ in range(head[6]):
            if end + 2 > MAX_PDU:
                return IMPOSSIBLE
            if len(head) < end + 2:
                return NEED_MORE
            end += 2 + head[end + 1]
        return end if end <= MAX_PDU else IMPOSSIBLE

    def decode(self, pdu: bytes, t_ns: int) -> DeviceIdentificationReply:
        objects, at = [], _IDENTIFICATION_HEAD
        for _ in range(pdu[6]):
            size = pdu[at + 1]
            objects.append((pdu[at], bytes(pdu[at + 2 : at + 2 + size])))
            at += 2 + size
        more = pdu[4] == 0xFF
        if more and pdu[5] <= self.object_id and self.read_code != 4:
            raise Desync("device identification repeats objects", got=short_hex(pdu))
        return DeviceIdentificationReply(tuple(objects), pdu[3], more, pdu[5], bytes(pdu[1:]), t_ns)
