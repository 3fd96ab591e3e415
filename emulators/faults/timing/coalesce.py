"""Frames that arrive together, as a busy stack or a USB adapter delivers them."""

from __future__ import annotations

from random import Random

from pydantic import Field

from fieldtwin.emulators.faults.fault import DelayedBytes, FaultEffect, Parameters, WireFault
from fieldtwin.emulators.faults.frames import FaultFrame


class Form(Parameters):
    every_ms: float = Field(default=20.0, gt=0, le=60_000)


class Coalesce(WireFault):
    name = "coalesce"
    summary = "frames are collected for `every_ms` and arrive in one piece"
    form = Form

    def apply(self, frame: FaultFrame, random: Random) -> FaultEffect:
        return FaultEffect((DelayedBytes(frame.data, self.parameters.every_ms / 1000, gather=True),))
