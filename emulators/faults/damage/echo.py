"""A two-wire adapter that receives its own frames."""

from __future__ import annotations

from random import Random

from fieldtwin.emulators.faults.fault import DelayedBytes, FaultEffect, WireFault
from fieldtwin.emulators.faults.frames import FaultFrame, FrameDirection


class Echo(WireFault):
    name = "echo"
    summary = "the sender receives its own frame before the reply"
    ways = frozenset((FrameDirection.REQUEST,))

    def apply(self, frame: FaultFrame, random: Random) -> FaultEffect:
        return FaultEffect((DelayedBytes(frame.data, back=True), DelayedBytes(frame.data)))
