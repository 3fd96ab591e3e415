"""A silence inside a frame, longer than a receiver accepts (SL 2.5.1.1: t1.5)."""

from __future__ import annotations

from random import Random

from pydantic import Field

from fieldtwin.emulators.faults.fault import DelayedBytes, FaultEffect, Parameters, WireFault
from fieldtwin.emulators.faults.frames import FaultFrame


class Form(Parameters):
    pause_ms: float = Field(default=40.0, gt=0, le=60_000)


class Pause(WireFault):
    name = "pause"
    summary = "a silence of `pause_ms` in the middle of the frame"
    form = Form
    divides = True

    def apply(self, frame: FaultFrame, random: Random) -> FaultEffect:
        half = len(frame.data) // 2
        return FaultEffect(
            (DelayedBytes(frame.data[:half]), DelayedBytes(frame.data[half:], self.parameters.pause_ms / 1000))
        )
