"""A node whose heartbeat is sometimes late."""

from __future__ import annotations

from random import Random

from pydantic import Field

from fieldtwin.emulators.faults.can_fault import HEARTBEAT, CanFault, CanPiece
from fieldtwin.emulators.faults.fault import Parameters
from fieldtwin.gateway.core.canframe import CanFrame


class Form(Parameters):
    most_ms: float = Field(default=300.0, gt=0, le=60_000)


class HeartbeatLate(CanFault):
    name = "heartbeat-late"
    summary = "the node's heartbeat arrives up to `most_ms` late"
    form = Form

    def aims_at(self, frame: CanFrame, node: int) -> bool:
        return frame.can_id == HEARTBEAT + node

    def apply(self, frame: CanFrame, node: int, random: Random) -> tuple[CanPiece, ...]:
        return (CanPiece(frame, random.uniform(0.0, self.parameters.most_ms / 1000)),)
