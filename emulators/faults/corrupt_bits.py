"""Bits that are read as others, anywhere in the frame."""

from __future__ import annotations

from random import Random

from pydantic import Field

from emulators.faults.fault import Outcome, Parameters, WireFault, passed
from emulators.faults.frames import Frame


class Form(Parameters):
    bits: int = Field(default=1, ge=1, le=64)


class CorruptBits(WireFault):
    name = "corrupt-bits"
    summary = "`bits` bits of the frame, anywhere, are turned over"
    form = Form

    def strike(self, frame: Frame, random: Random) -> Outcome:
        data = bytearray(frame.data)
        for place in random.sample(range(8 * len(data)), min(self.parameters.bits, 8 * len(data))):
            data[place // 8] ^= 1 << place % 8
        return passed(bytes(data))
