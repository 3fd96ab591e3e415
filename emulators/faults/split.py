"""A frame that arrives in two pieces."""

from __future__ import annotations

from random import Random

from pydantic import Field

from emulators.faults.fault import Outcome, Parameters, Piece, WireFault
from emulators.faults.frames import Frame


class Form(Parameters):
    at: int = Field(default=3, ge=1, le=1024)
    pause_ms: float = Field(default=1.0, ge=0, le=60_000)


class Split(WireFault):
    name = "split"
    summary = "the frame arrives cut behind `at` bytes, the rest `pause_ms` later"
    form = Form

    def strike(self, frame: Frame, random: Random) -> Outcome:
        at = self.parameters.at
        return Outcome((Piece(frame.data[:at]), Piece(frame.data[at:], self.parameters.pause_ms / 1000)))
