"""A node that sends no heartbeat."""

from __future__ import annotations

from random import Random

from fieldtwin.emulators.faults.can_fault import HEARTBEAT, CanFault, CanPiece
from fieldtwin.gateway.core.canframe import CanFrame


class HeartbeatLoss(CanFault):
    name = "heartbeat-loss"
    summary = "the node sends no heartbeat, but works otherwise"

    def aims_at(self, frame: CanFrame, node: int) -> bool:
        return frame.can_id == HEARTBEAT + node

    def apply(self, frame: CanFrame, node: int, random: Random) -> tuple[CanPiece, ...]:
        return ()
