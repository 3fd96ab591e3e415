"""A node whose heartbeat reports an undefined or wrong state."""

from __future__ import annotations

from random import Random

from pydantic import Field

from fieldtwin.emulators.faults.can_fault import HEARTBEAT, CanFault, CanPiece
from fieldtwin.emulators.faults.fault import Parameters
from fieldtwin.gateway.core.canframe import CanFrame


class Form(Parameters):
    state: int = Field(default=0x55, ge=0, le=0xFF)


class OddHeartbeat(CanFault):
    name = "odd-heartbeat"
    summary = (
        "the node's heartbeat reports `state`: 4 stopped, 5 operational, 127 pre-operational, 0 boot-up, other "
        "values undefined"
    )
    form = Form

    def aims_at(self, frame: CanFrame, node: int) -> bool:
        return frame.can_id == HEARTBEAT + node

    def apply(self, frame: CanFrame, node: int, random: Random) -> tuple[CanPiece, ...]:
        return (CanPiece(CanFrame(frame.can_id, bytes((self.parameters.state,)))),)
