"""A device that does not answer."""

from __future__ import annotations

from random import Random

from fieldtwin.emulators.faults.fault import LOST, FaultEffect, WireFault
from fieldtwin.emulators.faults.frames import FaultFrame, FrameDirection


class Silence(WireFault):
    name = "silence"
    summary = "the device never answers: its requests do not reach it"
    ways = frozenset((FrameDirection.REQUEST,))

    def apply(self, frame: FaultFrame, random: Random) -> FaultEffect:
        return LOST
