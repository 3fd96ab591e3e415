"""Further runs of failed seeds, which find the causes of failures: to know their faults, and with a part of these.

The runs use the workers of the campaign. Their number and their order have no effect on the causes that are found.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

from fieldtwin.gateway.core.errors import FieldtwinError
from fieldtwin.run.campaigns.causes import Cause, causes, of_shape, shape_of
from fieldtwin.run.campaigns.shrink import FurtherRuns, same_failure, shrunk_run
from fieldtwin.run.places.place import Ended, OpenWork, Place, SeedWork, UnitWork

RESULT = TypeVar("RESULT")
KEPT = TypeVar("KEPT")


class FaultyWork(SeedWork[RESULT], Protocol[RESULT]):
    """Work of a campaign whose runs have faults."""

    def faults_of(self, seed: int) -> Sequence[dict[str, Any]]:
        """Return the faults of the run of a seed."""

    def run_with(self, seed: int, faults: Sequence[dict[str, Any]]) -> RESULT:
        """Run the unit of a seed with these faults in place of its schedule."""

    def errors_of(self, result: RESULT) -> Sequence[str]:
        """Return the failures of a run, without parts that differ between a campaign and a scenario."""


@dataclass(frozen=True, slots=True)
class Rerun:
    """The run of a seed with these faults, or with the faults of its schedule that have a shape. `number`: its place among the
    runs that are given together.
    """

    number: int
    seed: int
    faults: tuple[dict[str, Any], ...] = ()
    shape: frozenset[str] | None = None

    def __str__(self) -> str:
        return f"{self.seed} with a part of its faults"


@dataclass(frozen=True, slots=True)
class FaultsOf:
    """The faults of the run of a seed, as a unit. Guided faults are known only after a run, so a worker makes it again."""

    seed: int

    def __str__(self) -> str:
        return f"{self.seed} to know its faults"


_Unit = Rerun | FaultsOf


@dataclass(frozen=True, slots=True)
class FaultSchedule:
    """The faults of a run."""

    faults: tuple[dict[str, Any], ...]


@dataclass(frozen=True, slots=True)
class Unfinished:
    """A run that no process could finish."""

    reason: str


@dataclass(frozen=True, slots=True)
class Reruns(Generic[RESULT]):
    """Further runs as work for a place."""

    work: FaultyWork[RESULT]

    @property
    def virtual_s(self) -> float:
        return self.work.virtual_s

    def run(self, unit: _Unit) -> RESULT | FaultSchedule | Unfinished:
        if isinstance(unit, FaultsOf):
            return FaultSchedule(tuple(self.work.faults_of(unit.seed)))
        faults = unit.faults if unit.shape is None else of_shape(self.work.faults_of(unit.seed), unit.shape)
        return self.work.run_with(unit.seed, faults)

    def unfinished(self, unit: _Unit, reason: str) -> RESULT | FaultSchedule | Unfinished:
        return Unfinished(f"the run of seed {unit} did not finish: {reason}")

    def hash_of(self, result: RESULT | FaultSchedule | Unfinished) -> str:
        """Return an empty text: no further run is repeated."""
        return ""

    def portable(self) -> tuple[Reruns[RESULT], tuple[Path, ...]]:
        work, files = self.work.portable()
        return Reruns(work), files


class SearchStopped(FieldtwinError):
    """The search for causes cannot continue, because its place is gone or because a run did not finish.

    A run that did not finish must not count as one that passes, because then lost workers would change the result.
    """


@dataclass(frozen=True, slots=True)
class Shrunk(Generic[RESULT]):
    """The fewest faults with which the run of a seed still fails in the same way: `faults`.

    `minimal`: all of them are necessary. `result`: the result with them. `without`: the result without any fault; the
    same as `result` if none is necessary.
    """

    seed: int
    faults: list[dict[str, Any]]
    minimal: bool
    result: RESULT
    without: RESULT


class CauseSearch(Generic[RESULT]):
    """The search for the causes of failed runs. `further` limits the number of its runs."""

    def __init__(
        self,
        work: FaultyWork[RESULT],
        opened: OpenWork[_Unit, RESULT | FaultSchedule | Unfinished],
        further: FurtherRuns,
    ) -> None:
        self._work, self._opened, self._further = work, opened, further

    def causes(self, failed: Mapping[int, RESULT]) -> Iterator[Cause[int, Shrunk[RESULT]]]:
        """Yield the causes of failed runs, given by seed (see `fieldtwin.run.campaigns.causes.causes`).

        Raises `SearchStopped`.
        """
        errors = {seed: self._work.errors_of(result) for seed, result in failed.items()}
        return causes(
            list(failed),
            errors.__getitem__,
            lambda seed: self._shrunk(seed, errors[seed]),
            lambda small, seeds: self._suffices(shape_of(small.faults), seeds, errors),
            self._further,
        )

    def _shrunk(self, seed: int, wanted: Sequence[str]) -> Shrunk[RESULT]:
        small = shrunk_run(
            self._faults_of(seed),
            lambda parts: self._each(
                [Rerun(n, seed, tuple(part)) for n, part in enumerate(parts)], lambda _, result: result
            ),
            lambda result: same_failure(wanted, self._work.errors_of(result)),
            self._further,
            self._parallel,
        )
        return Shrunk(seed, *small)

    def _faults_of(self, seed: int) -> tuple[dict[str, Any], ...]:
        """Return the faults of the run of a seed. Raises `SearchStopped`."""
        found: list[FaultSchedule] = []

        def ended(_: _Unit, result: RESULT | FaultSchedule) -> None:
            assert isinstance(result, FaultSchedule)
            found.append(result)

        self._run([FaultsOf(seed)], ended)
        return found[0].faults

    def _suffices(self, shape: frozenset[str], seeds: Sequence[int], errors: Mapping[int, Sequence[str]]) -> list[bool]:
        """Return for each seed whether its run fails in the same way with its faults of this shape only."""
        return self._each(
            [Rerun(n, seed, shape=shape) for n, seed in enumerate(seeds)],
            lambda rerun, result: same_failure(errors[rerun.seed], self._work.errors_of(result)),
        )

    def _each(self, reruns: Sequence[Rerun], kept: Callable[[Rerun, RESULT], KEPT]) -> list[KEPT]:
        """Return, in the order of `reruns`, what `kept` returns for each of them. Raises `SearchStopped`."""
        found: dict[int, KEPT] = {}

        def ended(unit: _Unit, result: RESULT | FaultSchedule) -> None:
            assert isinstance(unit, Rerun)
            assert not isinstance(result, FaultSchedule)
            found[unit.number] = kept(unit, result)

        self._run(reruns, ended)
        return [found[n] for n in range(len(reruns))]

    def _run(self, units: Sequence[_Unit], on_ended: Callable[[_Unit, RESULT | FaultSchedule], None]) -> None:
        """Run units on the workers. Raises `SearchStopped`, also for a unit that did not finish."""

        def ended(one: Ended[_Unit, RESULT | FaultSchedule | Unfinished]) -> None:
            if isinstance(one.result, Unfinished):
                raise SearchStopped(one.result.reason)
            on_ended(one.unit, one.result)

        with _stopped_by_errors():
            self._opened.run(units, ended)

    def _parallel(self) -> int:
        with _stopped_by_errors():
            return self._opened.parallel_units()


@contextmanager
def open_search(place: Place, work: FaultyWork[RESULT], further: FurtherRuns) -> Iterator[CauseSearch[RESULT]]:
    """Prepare the workers of a place for a search. Raises `SearchStopped` if the place is gone."""
    reruns: UnitWork[_Unit, RESULT | FaultSchedule | Unfinished] = Reruns(work)
    with ExitStack() as stack:
        with _stopped_by_errors():
            opened = stack.enter_context(place.open(reruns))
        yield CauseSearch(work, opened, further)


@contextmanager
def _stopped_by_errors() -> Iterator[None]:
    try:
        yield
    except SearchStopped:
        raise
    except (
        FieldtwinError
    ) as e:  # without its hint: a campaign that is resumed does not search the causes of recorded seeds
        raise SearchStopped(e.message, expected=e.expected, got=e.got, where=e.where) from e
