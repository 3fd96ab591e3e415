"""A node that reports one error after the other."""

from __future__ import annotations

from random import Random

from pydantic import Field

from fieldtwin.emulators.faults.can_fault import EMCY, CanFault, CanPiece, as_is
from fieldtwin.emulators.faults.fault import Parameters
from fieldtwin.gateway.core.canframe import CanFrame


class Form(Parameters):
    count: int = Field(default=20, ge=1, le=1000)
    code: int = Field(default=0x1000, ge=0x0000, le=0xFFFF)
    length: int = Field(default=8, ge=0, le=8)
    every_ms: float = Field(default=1.0, ge=0, le=60_000)


class EmcyBurst(CanFault):
    name = "emcy-burst"
    summary = "the node sends `count` EMCY messages of `code`, `every_ms` apart, `length` bytes long"
    form = Form

    def aims_at(self, frame: CanFrame, node: int) -> bool:
        return False  # the fault only adds frames

    def apply(self, frame: CanFrame, node: int, random: Random) -> tuple[CanPiece, ...]:
        return as_is(frame)

    def appears(self, node: int, random: Random) -> tuple[CanPiece, ...]:
        p = self.parameters
        data = int(p.code).to_bytes(2, "little") + bytes((1, 0, 0, 0, 0, 0))
        return tuple(CanPiece(CanFrame(EMCY + node, data[: p.length]), n * p.every_ms / 1000) for n in range(p.count))
