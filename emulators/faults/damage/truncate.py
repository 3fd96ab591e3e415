"""A frame that ends too early."""

from __future__ import annotations

from random import Random

from pydantic import Field

from fieldtwin.emulators.faults.fault import FaultEffect, Parameters, WireFault, passed
from fieldtwin.emulators.faults.frames import FaultFrame


class Form(Parameters):
    count: int = Field(default=2, ge=1, le=1024)


class Truncate(WireFault):
    name = "truncate"
    summary = "the last `count` bytes of the frame are missing"
    form = Form

    def apply(self, frame: FaultFrame, random: Random) -> FaultEffect:
        return passed(frame.data[: max(1, len(frame.data) - self.parameters.count)])
