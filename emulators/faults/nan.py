"""A sensor that has no value: not a number, or what its type says instead."""

from __future__ import annotations

from random import Random

from emulators.faults.fault import ValueFault


class NotANumber(ValueFault):
    name = "nan"
    summary = "the value is not a number; an integer takes what its type has for that"

    def distort(self, value: float, since_s: float, held: float, random: Random) -> float:
        return float("nan")
