"""A device that refuses a request with an exception."""

from __future__ import annotations

from random import Random

from pydantic import Field

from fieldtwin.emulators.faults.fault import FaultEffect, Parameters, WireFault, passed
from fieldtwin.emulators.faults.frames import MODBUS, FaultFrame
from fieldtwin.emulators.faults.remake import remade

CODES = {
    1: "illegal function",
    2: "illegal data address",
    3: "illegal data value",
    4: "server device failure",
    5: "acknowledge: processing takes longer",
    6: "server device busy",
    7: "negative acknowledge (older devices)",
    8: "memory parity error",
    10: "gateway path unavailable",
    11: "gateway target device failed to respond",
}
"""The exception codes of the standard (APP V1.1b3, 7). All other codes are vendor-specific."""


class Form(Parameters):
    code: int = Field(default=4, ge=1, le=255)


class ExceptionReply(WireFault):
    name = "exception"
    summary = "the reply is exception `code` (APP V1.1b3, 7)"
    form = Form
    codes = CODES
    framings = MODBUS

    def apply(self, frame: FaultFrame, random: Random) -> FaultEffect:
        if not frame.pdu:
            return passed(frame.data)
        return passed(remade(frame, pdu=bytes((frame.pdu[0] | 0x80, self.parameters.code))))
