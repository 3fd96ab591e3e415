"""A reply that arrives after the client has given up waiting."""

from __future__ import annotations

from random import Random

from pydantic import Field

from fieldtwin.emulators.faults.fault import DelayedBytes, FaultEffect, Parameters, WireFault
from fieldtwin.emulators.faults.frames import FaultFrame


class Form(Parameters):
    by_ms: float = Field(default=400.0, gt=0, le=600_000)


class LateReply(WireFault):
    name = "late-reply"
    summary = "the reply arrives `by_ms` late, and later replies may overtake it"
    form = Form

    def apply(self, frame: FaultFrame, random: Random) -> FaultEffect:
        return FaultEffect((DelayedBytes(frame.data, self.parameters.by_ms / 1000, overtake=True),))
