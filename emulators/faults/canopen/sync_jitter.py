"""SYNC messages that arrive at irregular intervals."""

from __future__ import annotations

from random import Random

from pydantic import Field

from fieldtwin.emulators.faults.can_fault import SYNC, CanFault, CanPiece
from fieldtwin.emulators.faults.fault import Parameters
from fieldtwin.emulators.faults.frames import FrameDirection
from fieldtwin.gateway.core.canframe import CanFrame


class Form(Parameters):
    most_ms: float = Field(default=5.0, gt=0, le=60_000)


class SyncJitter(CanFault):
    name = "sync-jitter"
    summary = "the node receives SYNC up to `most_ms` late"
    form = Form
    ways = frozenset((FrameDirection.REQUEST,))

    def aims_at(self, frame: CanFrame, node: int) -> bool:
        return frame.can_id == SYNC

    def apply(self, frame: CanFrame, node: int, random: Random) -> tuple[CanPiece, ...]:
        return (CanPiece(frame, random.uniform(0.0, self.parameters.most_ms / 1000)),)
