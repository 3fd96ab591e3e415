"""A sensor whose value is frozen."""

from __future__ import annotations

from random import Random

from fieldtwin.emulators.faults.fault import ValueFault


class Stuck(ValueFault):
    name = "stuck"
    summary = "the value keeps the value that it had when the fault began"

    def distort(self, value: float, since_s: float, held: float, random: Random) -> float:
        return held
