"""A frame of a node that is lost."""

from __future__ import annotations

from random import Random

from fieldtwin.emulators.faults.can_fault import CanFault, CanPiece
from fieldtwin.gateway.core.canframe import CanFrame


class LostFrame(CanFault):
    name = "lost-frame"
    summary = "a frame of the node is lost (narrow it with `cob_id`)"

    def apply(self, frame: CanFrame, node: int, random: Random) -> tuple[CanPiece, ...]:
        return ()
