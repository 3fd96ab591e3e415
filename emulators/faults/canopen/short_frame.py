"""Frames with fewer bytes than expected."""

from __future__ import annotations

from random import Random

from pydantic import Field

from fieldtwin.emulators.faults.can_fault import CanFault, CanPiece
from fieldtwin.emulators.faults.fault import Parameters
from fieldtwin.gateway.core.canframe import CanFrame


class Form(Parameters):
    length: int = Field(default=1, ge=0, le=7)


class ShortFrame(CanFault):
    name = "short-frame"
    summary = "a frame of the node ends after `length` bytes (narrow it with `cob_id`)"
    form = Form

    def apply(self, frame: CanFrame, node: int, random: Random) -> tuple[CanPiece, ...]:
        if frame.remote:
            return (CanPiece(frame),)
        return (CanPiece(CanFrame(frame.can_id, frame.data[: self.parameters.length], extended=frame.extended)),)
