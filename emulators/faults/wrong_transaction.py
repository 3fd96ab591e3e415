"""A reply to another transaction (Modbus TCP)."""

from __future__ import annotations

from random import Random

from pydantic import Field

from emulators.faults.fault import Outcome, Parameters, WireFault, passed
from emulators.faults.frames import Frame, Framing


class Form(Parameters):
    by: int = Field(default=1, ge=1, le=65535)


class WrongTransaction(WireFault):
    name = "wrong-transaction"
    summary = "the transaction id is `by` more; on a line, which has none, nothing happens"
    form = Form

    def strike(self, frame: Frame, random: Random) -> Outcome:
        if frame.framing is not Framing.MBAP or len(frame.data) < 2:
            return passed(frame.data)
        transaction = (int.from_bytes(frame.data[:2]) + self.parameters.by) & 0xFFFF
        return passed(transaction.to_bytes(2) + frame.data[2:])
