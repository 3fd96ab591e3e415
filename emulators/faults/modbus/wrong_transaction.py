"""A reply with a wrong transaction ID (Modbus TCP)."""

from __future__ import annotations

from random import Random

from pydantic import Field

from fieldtwin.emulators.faults.fault import FaultEffect, Parameters, WireFault, passed
from fieldtwin.emulators.faults.frames import FaultFrame, Framing


class Form(Parameters):
    by: int = Field(default=1, ge=0, le=65535)
    to: int = Field(default=-1, ge=-1, le=65535)
    protocol: int = Field(default=0, ge=0, le=65535)


class WrongTransaction(WireFault):
    name = "wrong-transaction"
    summary = (
        "the transaction ID is increased by `by`, or is `to` (-1: unset), and the protocol ID is `protocol`; no "
        "effect on a serial line, which has none"
    )
    form = Form
    framings = frozenset({Framing.MBAP})

    def apply(self, frame: FaultFrame, random: Random) -> FaultEffect:
        if frame.framing is not Framing.MBAP or len(frame.data) < 4:
            return passed(frame.data)
        p = self.parameters
        transaction = p.to if p.to >= 0 else (int.from_bytes(frame.data[:2]) + p.by) & 0xFFFF
        return passed(transaction.to_bytes(2) + int(p.protocol).to_bytes(2) + frame.data[4:])
