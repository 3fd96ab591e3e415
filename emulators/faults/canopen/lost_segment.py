"""A segment of an SDO transfer that is lost."""

from __future__ import annotations

from random import Random

from fieldtwin.emulators.faults.can_fault import SDO_REPLY, CanFault, CanPiece
from fieldtwin.gateway.core.canframe import CanFrame


class LostSegment(CanFault):
    name = "lost-segment"
    summary = "segments that the node sends in SDO transfers are lost"

    def aims_at(self, frame: CanFrame, node: int) -> bool:
        return frame.can_id == SDO_REPLY + node and bool(frame.data) and frame.data[0] >> 5 in (0, 1)

    def apply(self, frame: CanFrame, node: int, random: Random) -> tuple[CanPiece, ...]:
        return ()
