"""A synthetic inclinometer on a moored buoy: the mooring's steady tilt, and swell that repeats exactly every minute.

This module generates the shipped recording `incl.jsonl`. The recording contains whole periods of every wave, and its last row
equals its first, so that it can be played in a loop without a jump. The module accesses no files and no CANopen objects.
"""

from __future__ import annotations

import math
import random
from collections.abc import Iterator
from dataclasses import dataclass

SIGNALS = {"slope_long": "deg", "slope_lateral": "deg"}

Wave = tuple[int, float, float]
"""A wave: number of periods in the recording, amplitude in degrees, phase in radians."""


@dataclass(frozen=True, slots=True)
class Tilt:
    """The motion of the buoy. Slopes are in degrees. The waves are a slow swing on the mooring, and swell of 7.5 to 12 s."""

    duration_s: float = 60.0
    rate_hz: float = 10.0
    steady: tuple[float, float] = (2.4, -1.1)
    long_waves: tuple[Wave, ...] = ((1, 0.8, 0.3), (5, 3.1, 0.0), (7, 1.2, 1.9), (8, 0.5, 4.0))
    lateral_waves: tuple[Wave, ...] = ((1, 0.5, 2.0), (5, 1.4, 1.2), (6, 0.9, 5.1), (8, 0.4, 0.7))
    noise: float = 0.01


def tilt_rows(tilt: Tilt, chance: random.Random) -> Iterator[tuple[float, tuple[float, float]]]:
    """Yield times in seconds and the two slopes, rounded to a thousandth of a degree; the last row equals the first."""
    count = round(tilt.duration_s * tilt.rate_hz)
    first: tuple[float, float] | None = None
    for i in range(count):
        turn = 2 * math.pi * i / count
        slopes = tuple(
            round(steady + _waves(waves, turn) + tilt.noise * (chance.random() - chance.random()), 3)
            for steady, waves in zip(tilt.steady, (tilt.long_waves, tilt.lateral_waves), strict=True)
        )
        row = (slopes[0], slopes[1])
        first = first or row
        yield round(i / tilt.rate_hz, 6), row
    if first is not None:
        yield tilt.duration_s, first


def _waves(waves: tuple[Wave, ...], turn: float) -> float:
    return sum(amplitude * math.sin(times * turn + phase) for times, amplitude, phase in waves)
