"""A device that returns fewer registers than requested."""

from __future__ import annotations

from random import Random

from pydantic import Field

from fieldtwin.emulators.faults.fault import FaultEffect, Parameters, WireFault, passed
from fieldtwin.emulators.faults.frames import MODBUS, FaultFrame
from fieldtwin.emulators.faults.remake import remade

_BITS = frozenset((1, 2))
_REGISTERS = frozenset((3, 4, 23))


class Form(Parameters):
    by: int = Field(default=1, ge=1, le=125)


class FewerRegisters(WireFault):
    name = "fewer-registers"
    summary = (
        "the reply to a read lacks its last `by` registers (of bits: bytes); its byte count and check sum match "
        "the remaining data, at least one register"
    )
    form = Form
    framings = MODBUS
    functions = _BITS | _REGISTERS

    def apply(self, frame: FaultFrame, random: Random) -> FaultEffect:
        pdu = frame.pdu
        width = 1 if frame.function in _BITS else 2 if frame.function in _REGISTERS else 0
        if not width or pdu[0] & 0x80 or len(pdu) < 2 + width:
            return passed(frame.data)
        data = pdu[2:]
        kept = data[: max(width, len(data) - width * self.parameters.by)]
        return passed(remade(frame, pdu=bytes((pdu[0], len(kept))) + kept))
