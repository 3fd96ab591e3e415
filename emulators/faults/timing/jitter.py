"""Frames that arrive late, each by a different time."""

from __future__ import annotations

from random import Random

from pydantic import Field

from fieldtwin.emulators.faults.fault import DelayedBytes, FaultEffect, Parameters, WireFault
from fieldtwin.emulators.faults.frames import FaultFrame


class Form(Parameters):
    most_ms: float = Field(default=20.0, gt=0, le=600_000)


class Jitter(WireFault):
    name = "jitter"
    summary = "the frame arrives up to `most_ms` later (uniform distribution)"
    form = Form

    def apply(self, frame: FaultFrame, random: Random) -> FaultEffect:
        return FaultEffect((DelayedBytes(frame.data, random.uniform(0.0, self.parameters.most_ms / 1000)),))
