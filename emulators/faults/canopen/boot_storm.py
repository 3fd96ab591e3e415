"""A node that boots repeatedly."""

from __future__ import annotations

from random import Random

from pydantic import Field

from fieldtwin.emulators.faults.can_fault import HEARTBEAT, CanFault, CanPiece, as_is
from fieldtwin.emulators.faults.fault import Parameters
from fieldtwin.gateway.core.canframe import CanFrame


class Form(Parameters):
    count: int = Field(default=10, ge=1, le=1000)
    every_ms: float = Field(default=50.0, ge=0, le=60_000)


class BootStorm(CanFault):
    name = "boot-storm"
    summary = "the node sends `count` boot-up messages, `every_ms` apart"
    form = Form

    def aims_at(self, frame: CanFrame, node: int) -> bool:
        return False  # the fault only adds frames

    def apply(self, frame: CanFrame, node: int, random: Random) -> tuple[CanPiece, ...]:
        return as_is(frame)

    def appears(self, node: int, random: Random) -> tuple[CanPiece, ...]:
        p = self.parameters
        boot = CanFrame(HEARTBEAT + node, b"\0")
        return tuple(CanPiece(boot, n * p.every_ms / 1000) for n in range(p.count))
