"""A frame that arrives in two pieces."""

from __future__ import annotations

from random import Random

from pydantic import Field

from fieldtwin.emulators.faults.fault import DelayedBytes, FaultEffect, Parameters, WireFault
from fieldtwin.emulators.faults.frames import FaultFrame


class Form(Parameters):
    at: int = Field(default=3, ge=1, le=1024)
    pause_ms: float = Field(default=1.0, ge=0, le=60_000)
    times: int = Field(default=1, ge=1, le=1024)


class Split(WireFault):
    name = "split"
    summary = "the frame is split after `at` bytes, up to `times` times, with `pause_ms` between the pieces"
    form = Form
    divides = True

    def apply(self, frame: FaultFrame, random: Random) -> FaultEffect:
        p, left, cut = self.parameters, frame.data, list[bytes]()
        while len(left) > p.at and len(cut) < p.times:
            cut.append(left[: p.at])
            left = left[p.at :]
        return FaultEffect(tuple(DelayedBytes(data, n * p.pause_ms / 1000) for n, data in enumerate([*cut, left])))
