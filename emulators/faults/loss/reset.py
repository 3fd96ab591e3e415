"""A connection that is reset inside a frame (RST)."""

from __future__ import annotations

from random import Random

from pydantic import Field

from fieldtwin.emulators.faults.fault import ConnectionEffect, DelayedBytes, FaultEffect, Parameters, WireFault
from fieldtwin.emulators.faults.frames import FaultFrame


class Form(Parameters):
    at: int = Field(default=4, ge=0, le=1024)


class Reset(WireFault):
    name = "reset"
    summary = "the connection is reset after the first `at` bytes of the frame"
    form = Form

    def apply(self, frame: FaultFrame, random: Random) -> FaultEffect:
        return FaultEffect(
            (DelayedBytes(frame.data[: self.parameters.at]),) if self.parameters.at else (), ConnectionEffect.RESET
        )
