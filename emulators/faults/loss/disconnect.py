"""A device that disconnects, and returns when the fault is over."""

from __future__ import annotations

from random import Random

from fieldtwin.emulators.faults.fault import LOST, ConnectionEffect, FaultEffect, WireFault
from fieldtwin.emulators.faults.frames import FaultFrame, FrameDirection


class Disconnect(WireFault):
    name = "disconnect"
    summary = "connections are closed at once and new ones refused until the fault ends; a serial line loses all bytes until then"
    ways = frozenset(FrameDirection)
    refuses = True

    def apply(self, frame: FaultFrame, random: Random) -> FaultEffect:
        return LOST

    def appears(self) -> ConnectionEffect:
        return ConnectionEffect.CLOSE
