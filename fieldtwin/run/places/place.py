"""The seam between a campaign and the computers on which it runs.

The unit of work is one seed of one scenario or system. A `SeedWork` runs a unit, and a `Place` decides where. A place returns
each seed's result exactly once, whatever happens to the workers.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Generic, Protocol, Self, TypeVar

T = TypeVar("T")

SHORTEST_LIMIT_S = 600.0
"""The time limit of a short unit, in seconds of real time."""
LIMIT_FACTOR = 2.0
"""The time limit of a long unit, in seconds of real time for each second of virtual time."""


class SeedWork(Protocol[T]):
    """The work of a campaign: one run for each seed. It is pickled for the processes that run it."""

    @property
    def virtual_s(self) -> float:
        """Return how long a run takes at most, in seconds of virtual time."""

    def run(self, seed: int) -> T:
        """Run the unit of this seed. The same seed gives the same result on every computer."""

    def unfinished(self, seed: int, reason: str) -> T:
        """Return the result of a unit that no process could finish."""

    def hash_of(self, result: T) -> str:
        """Return the hash of the trace of a run, empty if the run did not finish."""

    def portable(self) -> tuple[Self, tuple[Path, ...]]:
        """Return this work with paths relative to the working directory, and all files that it reads.

        Raises `FileInvalid` for a file that cannot be copied to a different computer.
        """


@dataclass(frozen=True, slots=True)
class Ended(Generic[T]):
    """A unit that has ended. `worker` is the name of the cluster's worker that ran it, empty on this computer."""

    seed: int
    result: T
    worker: str = ""


class Repeats(Generic[T]):
    """The units that ran again on a different worker: how many, and those whose trace differs, each with both runs.

    A difference is a defect, because the same seed must give the same run.
    """

    def __init__(self, work: SeedWork[T]) -> None:
        self._work = work
        self.count = 0
        self.different: list[tuple[Ended[T], Ended[T]]] = []

    def add(self, first: Ended[T], second: Ended[T]) -> None:
        self.count += 1
        if self._work.hash_of(first.result) != self._work.hash_of(second.result):
            self.different.append((first, second))


class Place(Protocol):
    """Computers or processes that run units. Use it as a context manager."""

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None
    ) -> None: ...

    def run(
        self, work: SeedWork[T], seeds: Sequence[int], on_ended: Callable[[Ended[T]], None], repeats: Repeats[T]
    ) -> None:
        """Run a unit for each seed. `on_ended` is called in this thread with each seed once, in the order in which they end;
        `repeats` gets the units of the sample that ran again.

        When an exception such as KeyboardInterrupt ends this call, the units in progress are abandoned.
        """


def unit_limit_s(work: SeedWork[Any]) -> float:
    """Return the time limit of a unit in its own process, in seconds of real time."""
    return max(SHORTEST_LIMIT_S, LIMIT_FACTOR * work.virtual_s)
