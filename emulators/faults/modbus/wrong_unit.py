"""A frame with a wrong unit ID."""

from __future__ import annotations

from random import Random

from pydantic import Field

from fieldtwin.emulators.faults.fault import FaultEffect, Parameters, WireFault, passed
from fieldtwin.emulators.faults.frames import MODBUS, FaultFrame
from fieldtwin.emulators.faults.remake import remade


class Form(Parameters):
    unit_id: int = Field(default=99, ge=0, le=255)


class WrongUnit(WireFault):
    name = "wrong-unit"
    summary = "the frame carries unit ID `unit_id` (with a correct check sum)"
    form = Form
    framings = MODBUS

    def apply(self, frame: FaultFrame, random: Random) -> FaultEffect:
        return passed(remade(frame, unit=self.parameters.unit_id))
