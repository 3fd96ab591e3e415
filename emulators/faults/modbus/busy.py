"""A device that answers exception 06 because it is busy."""

from __future__ import annotations

from random import Random

from fieldtwin.emulators.faults.fault import FaultEffect, WireFault, passed
from fieldtwin.emulators.faults.frames import MODBUS, FaultFrame
from fieldtwin.emulators.faults.remake import remade


class Busy(WireFault):
    name = "busy"
    summary = "the reply is exception 06, server device busy"
    framings = MODBUS

    def apply(self, frame: FaultFrame, random: Random) -> FaultEffect:
        return passed(remade(frame, pdu=bytes((frame.pdu[0] | 0x80, 6)))) if frame.pdu else passed(frame.data)
