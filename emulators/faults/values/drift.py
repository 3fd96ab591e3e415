"""A sensor whose value drifts."""

from __future__ import annotations

from random import Random

from fieldtwin.emulators.faults.fault import Parameters, ValueFault


class Form(Parameters):
    per_s: float = 0.1


class Drift(ValueFault):
    name = "drift"
    summary = "the value drifts by `per_s` per second"
    form = Form

    def distort(self, value: float, since_s: float, held: float, random: Random) -> float:
        return value + float(self.parameters.per_s) * since_s
