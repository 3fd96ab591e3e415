"""A frame with a wrong function code."""

from __future__ import annotations

from random import Random

from pydantic import Field

from fieldtwin.emulators.faults.fault import FaultEffect, Parameters, WireFault, passed
from fieldtwin.emulators.faults.frames import MODBUS, FaultFrame
from fieldtwin.emulators.faults.remake import remade


class Form(Parameters):
    code: int = Field(default=4, ge=0, le=255)


class WrongFunction(WireFault):
    name = "wrong-function"
    summary = "the frame carries function `code` (with a correct check sum)"
    form = Form
    framings = MODBUS

    def apply(self, frame: FaultFrame, random: Random) -> FaultEffect:
        if not frame.pdu:
            return passed(frame.data)
        return passed(remade(frame, pdu=bytes((self.parameters.code,)) + frame.pdu[1:]))
