"""Bytes behind a frame that belong to nothing."""

from __future__ import annotations

from random import Random

from pydantic import Field

from emulators.faults.fault import Outcome, Parameters, WireFault, passed
from emulators.faults.frames import Frame


class Form(Parameters):
    count: int = Field(default=4, ge=1, le=1024)


class Garbage(WireFault):
    name = "garbage"
    summary = "`count` bytes that mean nothing follow the frame at once"
    form = Form

    def strike(self, frame: Frame, random: Random) -> Outcome:
        return passed(frame.data + random.randbytes(self.parameters.count))
