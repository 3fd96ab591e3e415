"""The processes of this computer as a place for the units of a campaign."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from types import TracebackType
from typing import Generic, Self

from fieldtwin.run.places.place import UNIT, Ended, Repeats, T, UnitWork, unit_limit_s
from fieldtwin.run.places.unit_processes import UnitLost, UnitProcesses


@dataclass(frozen=True, slots=True)
class LocalPlace:
    """`jobs` processes of this computer. One job has a process too, because only a process can be ended at the time limit.

    No unit is repeated: all processes have the same interpreter and the same packages. At most two units for each process are
    in progress.
    """

    jobs: int = 1

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        """Do nothing: each campaign ends its processes itself."""

    @contextmanager
    def open(self, work: UnitWork[UNIT, T]) -> Iterator[_LocalWork[UNIT, T]]:
        processes = UnitProcesses(pickle.dumps(work), Path.cwd(), unit_limit_s(work))
        pool = ThreadPoolExecutor(self.jobs)  # a process ends with the thread that started it, so the threads stay
        try:
            yield _LocalWork(work, self.jobs, processes, pool)
        finally:
            processes.close()
            pool.shutdown(cancel_futures=True)


@dataclass(frozen=True, slots=True)
class _LocalWork(Generic[UNIT, T]):
    """Work with its processes, and a thread for each of them."""

    work: UnitWork[UNIT, T]
    jobs: int
    processes: UnitProcesses
    pool: ThreadPoolExecutor

    def parallel_units(self) -> int:
        return self.jobs

    def run(
        self,
        units: Sequence[UNIT],
        on_ended: Callable[[Ended[UNIT, T]], None],
        repeats: Repeats[UNIT, T] | None = None,
    ) -> None:
        left, waiting = iter(units), set[Future[Ended[UNIT, T]]]()
        while True:
            waiting |= {self.pool.submit(self._ended, unit) for unit in islice(left, 2 * self.jobs - len(waiting))}
            if not waiting:
                return
            done, waiting = wait(waiting, return_when=FIRST_COMPLETED)
            for future in done:
                on_ended(future.result())

    def _ended(self, unit: UNIT) -> Ended[UNIT, T]:
        try:
            finished, result = pickle.loads(self.processes.run(pickle.dumps(unit)))
        except UnitLost as e:
            return Ended(unit, self.work.unfinished(unit, str(e)))
        if not finished:
            raise result
        return Ended(unit, result)
