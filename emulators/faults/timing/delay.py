"""A frame that arrives late."""

from __future__ import annotations

from random import Random

from pydantic import Field

from fieldtwin.emulators.faults.fault import DelayedBytes, FaultEffect, Parameters, WireFault
from fieldtwin.emulators.faults.frames import FaultFrame


class Form(Parameters):
    by_ms: float = Field(default=50.0, gt=0, le=600_000)


class Delay(WireFault):
    name = "delay"
    summary = "the frame arrives `by_ms` later, and delays the frames after it"
    form = Form

    def apply(self, frame: FaultFrame, random: Random) -> FaultEffect:
        return FaultEffect((DelayedBytes(frame.data, self.parameters.by_ms / 1000),))
