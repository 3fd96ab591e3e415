"""An SDO server that does not toggle its toggle bit."""

from __future__ import annotations

from random import Random

from fieldtwin.emulators.faults.can_fault import SDO_REPLY, CanFault, CanPiece
from fieldtwin.gateway.core.canframe import CanFrame


class SdoToggle(CanFault):
    name = "sdo-toggle"
    summary = "segments of SDO transfers carry the wrong toggle bit"

    def aims_at(self, frame: CanFrame, node: int) -> bool:
        segment = frame.data[:1] and frame.data[0] >> 5 in (0, 1)
        return frame.can_id == SDO_REPLY + node and bool(segment)

    def apply(self, frame: CanFrame, node: int, random: Random) -> tuple[CanPiece, ...]:
        return (CanPiece(CanFrame(frame.can_id, bytes((frame.data[0] ^ 0x10,)) + frame.data[1:])),)
