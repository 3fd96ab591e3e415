"""An SDO server that aborts the transfer."""

from __future__ import annotations

from random import Random

from pydantic import Field

from fieldtwin.emulators.canopen.aborts import MEANINGS
from fieldtwin.emulators.faults.can_fault import SDO_REPLY, CanFault, CanPiece
from fieldtwin.emulators.faults.fault import Parameters
from fieldtwin.gateway.core.canframe import CanFrame


class Form(Parameters):
    code: int = Field(default=0x08000000, ge=0, le=0xFFFFFFFF)


class SdoAbort(CanFault):
    name = "sdo-abort"
    summary = "the node answers SDO requests with abort `code` (CiA 301, 7.2.4.3.17)"
    form = Form
    codes = {int(code): text for code, text in MEANINGS.items()}  # noqa: RUF012  the class says so

    def __init__(self, parameters: Parameters) -> None:
        super().__init__(parameters)
        self._object = bytes(3)

    def aims_at(self, frame: CanFrame, node: int) -> bool:
        return frame.can_id == SDO_REPLY + node and len(frame.data) == 8 and frame.data[0] != 0x80

    def apply(self, frame: CanFrame, node: int, random: Random) -> tuple[CanPiece, ...]:
        if frame.data[0] >> 5 in (2, 3):  # an initiate names the object, a segment does not
            self._object = frame.data[1:4]
        data = b"\x80" + self._object + int(self.parameters.code).to_bytes(4, "little")
        return (CanPiece(CanFrame(frame.can_id, data)),)
