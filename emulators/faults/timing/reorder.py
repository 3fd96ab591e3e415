"""A frame that is overtaken by the next one."""

from __future__ import annotations

from random import Random

from pydantic import Field

from fieldtwin.emulators.faults.fault import DelayedBytes, FaultEffect, Parameters, WireFault
from fieldtwin.emulators.faults.frames import FaultFrame


class Form(Parameters):
    most_ms: float = Field(default=100.0, gt=0, le=60_000)


class Reorder(WireFault):
    name = "reorder"
    summary = "the frame is held back until the next one in its direction has gone, or for `most_ms`"
    form = Form

    def __init__(self, parameters: Parameters) -> None:
        super().__init__(parameters)
        self._held: FaultFrame | None = None

    def apply(self, frame: FaultFrame, random: Random) -> FaultEffect:
        before, self._held = self._held, None
        if before is not None:
            return FaultEffect((DelayedBytes(frame.data, overtake=True), DelayedBytes(before.data, overtake=True)))
        self._held = frame
        return FaultEffect(
            (DelayedBytes(frame.data, self.parameters.most_ms / 1000, overtake=True, gone=lambda: self._went(frame)),)
        )

    def _went(self, frame: FaultFrame) -> bool:
        """Return whether the delayed frame has already been sent after a later frame.

        If not, the caller sends it now, because its delay has ended.
        """
        if self._held is not frame:
            return True
        self._held = None
        return False
