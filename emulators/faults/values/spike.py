"""A sensor whose value jumps occasionally."""

from __future__ import annotations

from random import Random

from pydantic import Field

from fieldtwin.emulators.faults.fault import Parameters, ValueFault


class Form(Parameters):
    by: float = 100.0
    probability_each: float = Field(default=0.1, ge=0.0, le=1.0)


class Spike(ValueFault):
    name = "spike"
    summary = "with `probability_each` the value is wrong by `by` for one reading"
    form = Form

    def distort(self, value: float, since_s: float, held: float, random: Random) -> float:
        return value + float(self.parameters.by) if random.random() < self.parameters.probability_each else value
