"""A sensor without a value: NaN, or the value that its type uses instead."""

from __future__ import annotations

from random import Random

from fieldtwin.emulators.faults.fault import ValueFault


class NotANumber(ValueFault):
    name = "nan"
    summary = (
        "the value is not a number; an integer register holds its type's substitute, an integer object keeps its value"
    )

    def distort(self, value: float, since_s: float, held: float, random: Random) -> float:
        return float("nan")
