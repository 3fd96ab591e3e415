"""A synthetic CTD cast: a stratified ocean, a probe on a winch, a heaving ship, and imperfect sensors.

This module generates the shipped recording `cast.jsonl`. It is deterministic, because the caller passes the random generator. It
accesses no files and no registers.
"""

from __future__ import annotations

import math
import random
from collections.abc import Iterator
from dataclasses import dataclass

from fieldtwin.emulators.models.synthetic.seawater import conductivity

SIGNALS = {"pressure": "dbar", "temperature": "degC", "conductivity": "S/m"}


@dataclass(frozen=True, slots=True)
class Cast:
    """Parameters of the cast. Pressures in dbar, speeds in dbar/s, times in seconds."""

    soak_pressure: float = 5.0
    soak_s: float = 60.0
    bottom_pressure: float = 500.0
    bottom_s: float = 30.0
    speed: float = 1.0
    surface_pressure: float = 1.0
    duration_s: float = 1200.0
    rate_hz: float = 4.0

    def winch_pressure(self, t_s: float) -> float:
        """Return the pressure at which the winch holds the probe: soak, down, bottom, up, and then at the surface."""
        way = (self.bottom_pressure - self.soak_pressure) / self.speed
        if t_s < self.soak_s:
            return self.soak_pressure
        t_s -= self.soak_s
        if t_s < way:
            return self.soak_pressure + self.speed * t_s
        t_s -= way
        if t_s < self.bottom_s:
            return self.bottom_pressure
        t_s -= self.bottom_s
        return max(self.surface_pressure, self.bottom_pressure - self.speed * t_s)


def water_temperature(pressure: float) -> float:
    """Return the temperature in degC (ITS-90): a mixed layer of 24, a thermocline around 55 dbar, and a slow fall below."""
    return 5.2 + 9.3 * math.exp(-pressure / 260.0) + 9.8 * _above(pressure, 55.0, 14.0)


def water_salinity(pressure: float) -> float:
    """Return the practical salinity: fresher water on top, a halocline around 35 dbar, a maximum near 120 dbar."""
    maximum = 0.55 * math.exp(-(((pressure - 120.0) / 60.0) ** 2))
    return 35.05 - 1.3 * _above(pressure, 35.0, 9.0) + maximum


def cast_rows(cast: Cast, chance: random.Random) -> Iterator[tuple[float, tuple[float, float, float]]]:
    """Yield the time in seconds with pressure, temperature and conductivity as the instrument would report them.

    The ship's heave moves the probe. The temperature sensor responds with a delay of 0.25 s, which also applies to the
    conductivity cell (it is pumped through the same duct). Each sensor has its noise. Values are rounded to the
    resolution of the instrument.
    """
    step_s = 1.0 / cast.rate_hz
    lag = 1.0 - math.exp(-step_s / 0.25)
    felt = water_temperature(cast.soak_pressure)
    for i in range(round(cast.duration_s * cast.rate_hz) + 1):
        t_s = i * step_s
        heave = 0.35 * math.sin(2 * math.pi * t_s / 8.3) + 0.15 * math.sin(2 * math.pi * t_s / 5.7 + 1.0)
        pressure = max(0.0, cast.winch_pressure(t_s) + heave)
        felt += lag * (water_temperature(pressure) - felt)
        ideal = conductivity(water_salinity(pressure), felt, pressure)
        yield (
            t_s,
            (
                round(pressure + _noise(chance, 0.01), 3),
                round(felt + _noise(chance, 0.0008), 4),
                round(ideal + _noise(chance, 0.00008), 5),
            ),
        )


def _above(pressure: float, middle: float, width: float) -> float:
    """Return a smooth step: 1 well above the depth `middle`, 0 well below it."""
    return 0.5 * (1.0 - math.tanh((pressure - middle) / width))


def _noise(chance: random.Random, deviation: float) -> float:
    """Return approximately normal noise (the sum of twelve uniform numbers).

    It is the same on every machine, because it uses only sums and no library functions.
    """
    return deviation * (sum(chance.random() for _ in range(12)) - 6.0)
