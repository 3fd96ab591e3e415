"""A frame that arrives twice."""

from __future__ import annotations

from random import Random

from pydantic import Field

from fieldtwin.emulators.faults.fault import DelayedBytes, FaultEffect, Parameters, WireFault
from fieldtwin.emulators.faults.frames import FaultFrame


class Form(Parameters):
    times: int = Field(default=1, ge=1, le=100)
    after_ms: float = Field(default=0.0, ge=0, le=60_000)


class Duplicate(WireFault):
    name = "duplicate"
    summary = "the frame arrives again, `after_ms` later"
    form = Form

    def apply(self, frame: FaultFrame, random: Random) -> FaultEffect:
        again = DelayedBytes(frame.data, self.parameters.after_ms / 1000)
        return FaultEffect((DelayedBytes(frame.data), *[again] * self.parameters.times))
