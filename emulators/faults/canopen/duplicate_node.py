"""Two nodes with one node ID: the second one also answers and sends heartbeats."""

from __future__ import annotations

from random import Random

from fieldtwin.emulators.faults.can_fault import HEARTBEAT, SDO_REPLY, CanFault, CanPiece
from fieldtwin.gateway.core.canframe import CanFrame


class DuplicateNode(CanFault):
    name = "duplicate-node"
    summary = "a second node with this node ID answers each SDO request and sends heartbeats with a different state"

    def aims_at(self, frame: CanFrame, node: int) -> bool:
        return frame.can_id in (HEARTBEAT + node, SDO_REPLY + node)

    def apply(self, frame: CanFrame, node: int, random: Random) -> tuple[CanPiece, ...]:
        if frame.can_id == HEARTBEAT + node:
            return CanPiece(frame), CanPiece(CanFrame(frame.can_id, b"\x7f"), 0.001)
        return CanPiece(frame), CanPiece(frame, 0.001)
