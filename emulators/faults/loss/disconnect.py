"""A device that disconnects, and returns when the fault is over."""

from __future__ import annotations

from random import Random

from fieldtwin.emulators.faults.fault import LOST, FaultEffect, Hang, WireFault
from fieldtwin.emulators.faults.frames import Frame, Way


class Disconnect(WireFault):
    name = "disconnect"
    summary = (
        "connections are closed at once and new ones refused until the fault ends; a serial line is dead meanwhile"
    )
    ways = frozenset(Way)
    refuses = True

    def strike(self, frame: Frame, random: Random) -> FaultEffect:
        return LOST

    def appears(self) -> Hang:
        return Hang.CLOSE
