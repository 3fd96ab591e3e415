"""A device with a wrong baud rate: framing errors and bytes that were never sent."""

from __future__ import annotations

from random import Random

from pydantic import Field

from fieldtwin.emulators.faults.fault import LOST, FaultEffect, Parameters, WireFault, passed
from fieldtwin.emulators.faults.frames import FaultFrame


class Form(Parameters):
    factor: float = Field(default=0.5, gt=0, le=16)


class WrongBaud(WireFault):
    name = "wrong-baud"
    summary = "each byte arrives as different bytes, or not at all, as with a baud rate that is wrong by `factor`"
    form = Form

    def apply(self, frame: FaultFrame, random: Random) -> FaultEffect:
        heard = bytearray()
        credit = 0.0
        for byte in frame.data:
            credit += self.parameters.factor
            while credit >= 1.0:
                credit -= 1.0
                heard.append((byte * 0x55 ^ random.getrandbits(8)) & 0xFF)
        return passed(bytes(heard)) if heard else LOST
