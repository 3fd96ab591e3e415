"""Inverted bits anywhere in the frame."""

from __future__ import annotations

from random import Random

from pydantic import Field

from fieldtwin.emulators.faults.fault import FaultEffect, Parameters, WireFault, passed
from fieldtwin.emulators.faults.frames import FaultFrame
from fieldtwin.emulators.faults.remake import remade


class Form(Parameters):
    bits: int = Field(default=1, ge=1, le=64)
    fits: bool = False


class CorruptBits(WireFault):
    name = "corrupt-bits"
    summary = (
        "`bits` random bits of the frame are inverted; with `fits` only bits after the function code, and the "
        "check sum is corrected"
    )
    form = Form

    def apply(self, frame: FaultFrame, random: Random) -> FaultEffect:
        bits = self.parameters.bits
        if self.parameters.fits and frame.pdu:
            return passed(remade(frame, pdu=frame.pdu[:1] + _turned(frame.pdu[1:], bits, random)))
        return passed(_turned(frame.data, bits, random))


def _turned(raw: bytes, bits: int, random: Random) -> bytes:
    data = bytearray(raw)
    for place in random.sample(range(8 * len(data)), min(bits, 8 * len(data))):
        data[place // 8] ^= 1 << place % 8
    return bytes(data)
