"""A length field that does not match the data."""

from __future__ import annotations

from random import Random

from pydantic import Field

from fieldtwin.emulators.faults.fault import FaultEffect, Parameters, WireFault, passed
from fieldtwin.emulators.faults.frames import MODBUS, FaultFrame, Framing
from fieldtwin.emulators.faults.remake import remade


class Form(Parameters):
    by: int = Field(default=2, ge=-255, le=255)


class CorruptLength(WireFault):
    name = "corrupt-length"
    summary = (
        "the length field is `by` too large: the MBAP length, or on a serial line the byte count of a read reply "
        "(with a correct check sum)"
    )
    form = Form
    framings = MODBUS

    def apply(self, frame: FaultFrame, random: Random) -> FaultEffect:
        by = self.parameters.by
        if frame.framing is Framing.MBAP:
            length = (int.from_bytes(frame.data[4:6]) + by) & 0xFFFF
            return passed(frame.data[:4] + length.to_bytes(2) + frame.data[6:])
        if len(frame.pdu) < 3:
            return passed(frame.data)
        return passed(remade(frame, pdu=frame.pdu[:1] + bytes(((frame.pdu[1] + by) & 0xFF,)) + frame.pdu[2:]))
