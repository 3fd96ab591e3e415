"""A sensor beyond its range."""

from __future__ import annotations

from random import Random

from emulators.faults.fault import Parameters, ValueFault


class Form(Parameters):
    value: float = 1.0e9


class OutOfRange(ValueFault):
    name = "out-of-range"
    summary = "the value is `value`"
    form = Form

    def distort(self, value: float, since_s: float, held: float, random: Random) -> float:
        return float(self.parameters.value)
