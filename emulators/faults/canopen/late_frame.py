"""A node that is slow to send."""

from __future__ import annotations

from random import Random

from pydantic import Field

from fieldtwin.emulators.faults.can_fault import CanFault, CanPiece
from fieldtwin.emulators.faults.fault import Parameters
from fieldtwin.gateway.core.canframe import CanFrame


class Form(Parameters):
    by_ms: float = Field(default=400.0, gt=0, le=60_000)


class LateFrame(CanFault):
    name = "late-frame"
    summary = "a frame of the node arrives `by_ms` late (narrow it with `cob_id`)"
    form = Form

    def apply(self, frame: CanFrame, node: int, random: Random) -> tuple[CanPiece, ...]:
        return (CanPiece(frame, self.parameters.by_ms / 1000),)
