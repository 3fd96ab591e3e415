"""Bytes before a frame, as a line that floats while nobody drives it."""

from __future__ import annotations

from random import Random

from pydantic import Field

from emulators.faults.fault import Outcome, Parameters, Piece, WireFault
from emulators.faults.frames import Frame


class Form(Parameters):
    count: int = Field(default=3, ge=1, le=1024)
    lead_ms: float = Field(default=0.0, ge=0, le=60_000)


class Noise(WireFault):
    name = "noise"
    summary = "`count` bytes that mean nothing precede the frame, `lead_ms` before it"
    form = Form

    def strike(self, frame: Frame, random: Random) -> Outcome:
        return Outcome(
            (Piece(random.randbytes(self.parameters.count)), Piece(frame.data, self.parameters.lead_ms / 1000))
        )
