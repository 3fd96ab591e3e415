"""A connection whose peer has disappeared without closing it."""

from __future__ import annotations

from random import Random

from fieldtwin.emulators.faults.fault import ConnectionEffect, FaultEffect, WireFault
from fieldtwin.emulators.faults.frames import FaultFrame


class HalfOpen(WireFault):
    name = "half-open"
    summary = "from this frame on, the connection silently carries no data"

    def apply(self, frame: FaultFrame, random: Random) -> FaultEffect:
        return FaultEffect(connection=ConnectionEffect.HALF_OPEN)
