"""A sensor without a value: NaN, or the value that its type uses instead."""

from __future__ import annotations

from random import Random

from fieldtwin.emulators.faults.fault import ValueFault


class NotANumber(ValueFault):
    name = "nan"
    summary = "no number; an integer register holds what its type has for that, an integer object what it held"

    def distort(self, value: float, since_s: float, held: float, random: Random) -> float:
        return float("nan")
