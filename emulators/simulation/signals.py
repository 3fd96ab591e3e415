"""Signals of a device that come from a simulation and are used like recorded signals."""

from __future__ import annotations

from collections.abc import Mapping

from fieldtwin.emulators.signals import Signals
from fieldtwin.emulators.simulation.simulation import Simulation
from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.errors import FileInvalid


class SimulatedSignals(Signals):
    """The simulated signals of a device. `plays` maps each signal to a name in the simulation.

    Other signals do not exist. `path` is the file that error messages name.
    """

    def __init__(self, simulation: Simulation, plays: Mapping[str, str], path: str) -> None:
        self.names = tuple(plays)
        self.path = path
        self.start_ns = simulation.start_ns
        self._simulation = simulation
        self._plays = dict(plays)

    def __len__(self) -> int:
        """Return 0, because a simulation has no rows and is never used up."""
        return 0

    def position_s(self, now_ns: int) -> float:
        return (now_ns - self.start_ns) / NS_PER_S

    def values(self, now_ns: int) -> dict[str, float]:
        values = self._simulation.values(now_ns)
        return {signal: values[name] for signal, name in self._plays.items()}

    def values_at(self, position_s: float) -> dict[str, float]:
        return self.values(self.start_ns + round(position_s * NS_PER_S))

    def begin_with(self, values: Mapping[str, float], now_ns: int) -> bool:
        """Set values to continue from. Only formulas support it: a Python model keeps its own state."""
        return self._simulation.begin_with({self._plays[s]: value for s, value in values.items() if s in self._plays})

    def at(self, now_ns: int, name: str) -> float:
        if name not in self._plays:
            raise FileInvalid(
                "the simulation has no such signal", path=self.path, expected=", ".join(self.names), got=name
            )
        return self._simulation.values(now_ns)[self._plays[name]]
