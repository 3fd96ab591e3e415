"""A disturbance that adds bytes before a frame, as on a floating line that no device drives."""

from __future__ import annotations

from random import Random

from pydantic import Field

from fieldtwin.emulators.faults.fault import HEX, DelayedBytes, FaultEffect, Parameters, WireFault, passed
from fieldtwin.emulators.faults.frames import FaultFrame


class Form(Parameters):
    count: int = Field(default=3, ge=1, le=1024)
    lead_ms: float = Field(default=0.0, ge=0, le=60_000)
    data: str = Field(default="", pattern=HEX, max_length=3072)


class Noise(WireFault):
    name = "noise"
    summary = "`count` random bytes, or the bytes of `data` (hex), precede the frame by `lead_ms`"
    form = Form

    def apply(self, frame: FaultFrame, random: Random) -> FaultEffect:
        p = self.parameters
        before = bytes.fromhex(p.data) or random.randbytes(p.count)
        if not p.lead_ms:
            return passed(before + frame.data)
        return FaultEffect((DelayedBytes(before), DelayedBytes(frame.data, p.lead_ms / 1000)))
