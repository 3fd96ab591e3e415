"""Two devices that transmit on a line at the same time, so that both frames are destroyed."""

from __future__ import annotations

from random import Random

from pydantic import Field

from fieldtwin.emulators.faults.fault import FaultEffect, Parameters, WireFault, passed
from fieldtwin.emulators.faults.frames import FaultFrame


class Form(Parameters):
    at: int = Field(default=2, ge=0, le=1024)


class Collision(WireFault):
    name = "collision"
    summary = "a second sender collides with the frame from byte `at` on: each byte is the AND of both, as on RS485"
    form = Form

    def apply(self, frame: FaultFrame, random: Random) -> FaultEffect:
        at = self.parameters.at
        over = random.randbytes(max(0, len(frame.data) - at))
        mixed = bytes(a & b for a, b in zip(frame.data[at:], over, strict=True))
        return passed(frame.data[:at] + mixed)
