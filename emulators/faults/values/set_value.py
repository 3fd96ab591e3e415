"""A fixed value that replaces the recorded one."""

from __future__ import annotations

from random import Random

from fieldtwin.emulators.faults.fault import Parameters, ValueFault


class Form(Parameters):
    value: float = 0.0


class SetValue(ValueFault):
    name = "set"
    summary = "the value is `value`"
    form = Form

    def distort(self, value: float, since_s: float, held: float, random: Random) -> float:
        return float(self.parameters.value)
