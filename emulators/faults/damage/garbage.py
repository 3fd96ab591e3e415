"""A disturbance that adds bytes after a frame. These bytes do not belong to any frame."""

from __future__ import annotations

from random import Random

from pydantic import Field

from fieldtwin.emulators.faults.fault import HEX, FaultEffect, Parameters, WireFault, passed
from fieldtwin.emulators.faults.frames import FaultFrame


class Form(Parameters):
    count: int = Field(default=4, ge=1, le=1024)
    data: str = Field(default="", pattern=HEX, max_length=3072)


class Garbage(WireFault):
    name = "garbage"
    summary = "`count` random bytes, or the bytes of `data` (hex), follow the frame immediately"
    form = Form

    def apply(self, frame: FaultFrame, random: Random) -> FaultEffect:
        return passed(frame.data + (bytes.fromhex(self.parameters.data) or random.randbytes(self.parameters.count)))
