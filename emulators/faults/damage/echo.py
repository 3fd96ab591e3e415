"""A two-wire adapter that receives its own frames."""

from __future__ import annotations

from random import Random

from fieldtwin.emulators.faults.fault import FaultEffect, Piece, WireFault
from fieldtwin.emulators.faults.frames import Frame, Way


class Echo(WireFault):
    name = "echo"
    summary = "the sender receives its own frame before the reply"
    ways = frozenset((Way.REQUEST,))

    def strike(self, frame: Frame, random: Random) -> FaultEffect:
        return FaultEffect((Piece(frame.data, back=True), Piece(frame.data)))
