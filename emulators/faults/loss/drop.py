"""A frame that never arrives."""

from __future__ import annotations

from random import Random

from fieldtwin.emulators.faults.fault import LOST, FaultEffect, WireFault
from fieldtwin.emulators.faults.frames import FaultFrame, FrameDirection


class Drop(WireFault):
    name = "drop"
    summary = "the frame is lost"
    ways = frozenset(FrameDirection)

    def apply(self, frame: FaultFrame, random: Random) -> FaultEffect:
        return LOST
