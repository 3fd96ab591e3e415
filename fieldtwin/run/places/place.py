"""The seam between a campaign and the computers on which it runs.

The unit of work is one run of a scenario or system: a seed of the campaign, or a failed seed whose causes are searched. A
`UnitWork` runs a unit, and a `Place` decides where. A place returns each unit's result exactly once, whatever happens to the
workers.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Generic, Protocol, Self, TypeVar

T = TypeVar("T")
UNIT = TypeVar("UNIT")
UNIT_contra = TypeVar("UNIT_contra", contravariant=True)

SHORTEST_LIMIT_S = 600.0
"""The time limit of a short unit, in seconds of real time."""
LIMIT_FACTOR = 2.0
"""The time limit of a long unit, in seconds of real time for each second of virtual time."""


class UnitWork(Protocol[UNIT_contra, T]):
    """Work of a campaign: one run for each unit. Work and units are pickled for the processes that run them."""

    @property
    def virtual_s(self) -> float:
        """Return how long a run takes at most, in seconds of virtual time."""

    def run(self, unit: UNIT_contra, /) -> T:
        """Run a unit. The same unit gives the same result on every computer."""

    def unfinished(self, unit: UNIT_contra, reason: str, /) -> T:
        """Return the result of a unit that no process could finish."""

    def hash_of(self, result: T) -> str:
        """Return the hash of the trace of a run, empty if the run did not finish."""

    def portable(self) -> tuple[Self, tuple[Path, ...]]:
        """Return this work with paths relative to the working directory, and all files that it reads.

        Raises `FileInvalid` for a file that cannot be copied to a different computer.
        """


SeedWork = UnitWork[int, T]
"""The work of a campaign whose units are seeds."""


@dataclass(frozen=True, slots=True)
class Ended(Generic[UNIT, T]):
    """A unit that has ended. `worker` is the name of the cluster's worker that ran it, empty on this computer."""

    unit: UNIT
    result: T
    worker: str = ""


class Repeats(Generic[UNIT, T]):
    """The units that ran again on a different worker: how many, and those whose trace differs, each with both runs.

    A difference is a defect, because the same seed must give the same run. `sample`: the units that run again.
    """

    def __init__(self, work: UnitWork[UNIT, T], sample: frozenset[UNIT]) -> None:
        self._work, self.sample = work, sample
        self.count = 0
        self.different: list[tuple[Ended[UNIT, T], Ended[UNIT, T]]] = []

    def add(self, first: Ended[UNIT, T], second: Ended[UNIT, T]) -> None:
        self.count += 1
        if self._work.hash_of(first.result) != self._work.hash_of(second.result):
            self.different.append((first, second))


class OpenWork(Protocol[UNIT, T]):
    """Work whose files and processes stay on the workers, so that its units can be given in several steps."""

    def parallel_units(self) -> int:
        """Return how many units run at a time, at least 1. A cluster changes this number when workers come and go."""

    def run(
        self,
        units: Sequence[UNIT],
        on_ended: Callable[[Ended[UNIT, T]], None],
        repeats: Repeats[UNIT, T] | None = None,
    ) -> None:
        """Run the units. `on_ended` is called in this thread with each unit once, in the order in which they end; `repeats` gets
        the units of its sample that ran again on a different worker.

        When an exception such as KeyboardInterrupt ends this call, the units in progress are abandoned.
        """


class Place(Protocol):
    """Computers or processes that run units. Use it as a context manager."""

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None
    ) -> None: ...

    def open(self, work: UnitWork[UNIT, T]) -> AbstractContextManager[OpenWork[UNIT, T]]:
        """Prepare the workers for the units of `work`. The end of the block ends the processes that run them."""


def run_units(
    place: Place,
    work: UnitWork[UNIT, T],
    units: Sequence[UNIT],
    on_ended: Callable[[Ended[UNIT, T]], None],
    repeats: Repeats[UNIT, T] | None = None,
) -> None:
    """Run all units of `work` (see `OpenWork.run`). An empty list of units connects to no cluster."""
    if units:
        with place.open(work) as opened:
            opened.run(units, on_ended, repeats)


def unit_limit_s(work: UnitWork[Any, Any]) -> float:
    """Return the time limit of a unit in its own process, in seconds of real time."""
    return max(SHORTEST_LIMIT_S, LIMIT_FACTOR * work.virtual_s)
