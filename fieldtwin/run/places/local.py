"""The processes of this computer as a place for the units of a campaign."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Self

from fieldtwin.run.places.place import Ended, Repeats, SeedWork, T, unit_limit_s
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

    def run(
        self, work: SeedWork[T], seeds: Sequence[int], on_ended: Callable[[Ended[T]], None], repeats: Repeats[T]
    ) -> None:
        processes = UnitProcesses(pickle.dumps(work), Path.cwd(), unit_limit_s(work))
        pool = ThreadPoolExecutor(self.jobs)  # a process ends with the thread that started it, so the threads stay
        try:
            self._in(pool, partial(_unit, processes, work), seeds, on_ended)
        finally:
            processes.close()
            pool.shutdown(cancel_futures=True)

    def _in(
        self,
        pool: ThreadPoolExecutor,
        unit: Callable[[int], Ended[T]],
        seeds: Sequence[int],
        on_ended: Callable[[Ended[T]], None],
    ) -> None:
        left, waiting = iter(seeds), set[Future[Ended[T]]]()
        while True:
            while len(waiting) < 2 * self.jobs and (seed := next(left, None)) is not None:
                waiting.add(pool.submit(unit, seed))
            if not waiting:
                return
            done, waiting = wait(waiting, return_when=FIRST_COMPLETED)
            for future in done:
                on_ended(future.result())


def _unit(processes: UnitProcesses, work: SeedWork[T], seed: int) -> Ended[T]:
    try:
        finished, result = pickle.loads(processes.run(pickle.dumps(seed)))
    except UnitLost as e:
        return Ended(seed, work.unfinished(seed, str(e)))
    if not finished:
        raise result
    return Ended(seed, result)
