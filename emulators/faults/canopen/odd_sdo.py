"""Invalid SDO replies, or replies to a different request (CiA 301, 7.2.4)."""

from __future__ import annotations

from random import Random

from pydantic import Field

from fieldtwin.emulators.faults.can_fault import SDO_REPLY, CanFault, CanPiece
from fieldtwin.emulators.faults.fault import Parameters
from fieldtwin.gateway.core.canframe import CanFrame

_UPLOAD = 2
_EXPEDITED, _SIZED = 0x02, 0x01


class Form(Parameters):
    command: int = Field(default=-1, ge=-1, le=0xFF)
    index_by: int = Field(default=0, ge=0, le=0xFFFF)
    size_by: int = Field(default=0, ge=-1000, le=1000)
    no_size: bool = False
    before: int = Field(default=0, ge=0, le=1000)
    extended: bool = False


class OddSdo(CanFault):
    name = "odd-sdo"
    summary = (
        "SDO replies carry `command` (-1: unchanged), an index increased by `index_by`, a segmented size increased "
        "by `size_by`, no size (`no_size`) or an extended identifier; `before` replies with an unknown command "
        "precede them"
    )
    form = Form

    def aims_at(self, frame: CanFrame, node: int) -> bool:
        return frame.can_id == SDO_REPLY + node and len(frame.data) == 8

    def apply(self, frame: CanFrame, node: int, random: Random) -> tuple[CanPiece, ...]:
        p, data = self.parameters, bytearray(frame.data)
        if data[0] >> 5 in (_UPLOAD, 3):  # an initiate; segments name no object and no size
            index = (int.from_bytes(data[1:3], "little") + p.index_by) & 0xFFFF
            data[1:3] = index.to_bytes(2, "little")
            if data[0] >> 5 == _UPLOAD and not data[0] & _EXPEDITED and data[0] & _SIZED:
                size = int.from_bytes(data[4:8], "little") + p.size_by
                data[4:8] = max(0, size).to_bytes(4, "little")
            if data[0] >> 5 == _UPLOAD and p.no_size:
                data[0] &= 0xE2
                data[4:8] = data[4:8] if data[0] & _EXPEDITED else bytes(4)
        if p.command >= 0:
            data[0] = p.command
        junk = tuple(CanPiece(CanFrame(frame.can_id, bytes((0xE0 | n % 32,)) + bytes(7))) for n in range(p.before))
        return (*junk, CanPiece(CanFrame(frame.can_id, bytes(data), extended=p.extended)))
