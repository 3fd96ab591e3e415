"""The workers of a Dask cluster as a place for the units of a campaign.

Dask's scheduler distributes the units and gives those of a lost worker to a different one. This module keeps a bounded number of
units with the scheduler, counts each unit once, and runs a sample of the seeds again on a different worker.
"""

from __future__ import annotations

import contextlib
import pickle
import uuid
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass, replace
from itertools import islice
from queue import Empty, SimpleQueue
from types import TracebackType
from typing import Generic, Self

from distributed import Client, Future, KilledWorker

from fieldtwin.gateway.core.errors import Bug, ConnectionLost, FieldtwinError, Unreachable
from fieldtwin.run.places.bundle import bundle
from fieldtwin.run.places.dask_worker import Answer, CampaignParcel, CampaignPlugin, run_unit
from fieldtwin.run.places.environment import NotReproducible, local_environment
from fieldtwin.run.places.place import UNIT, Ended, Repeats, T, UnitWork, unit_limit_s

IN_FLIGHT_PER_THREAD = 2
"""Units with the scheduler for each thread of a worker, so that no thread waits for its next unit."""
MAX_IN_FLIGHT = 10_000
"""Largest number of units with the scheduler."""
MOST_SUBMITS = 3
"""How often a unit is given to the scheduler. Each time the scheduler itself tries several workers (`allowed-failures`)."""
POLL_S = 1.0
"""The time in seconds after which the workers are listed again if no unit ends."""
FETCH_S = 30.0
"""The time in seconds for the transfer of a result."""
LEDGER_HINT = "run the same command again: with --ledger it continues where it stopped"


class DaskPlace:
    """A cluster that `connect` connects to when the first campaign runs. `wait_s`: the longest time without a worker, in seconds.

    Use it as a context manager; the end of the block ends the connection, and the cluster if `connect` started it.
    """

    def __init__(self, connect: Callable[[], AbstractContextManager[Client]], name: str, wait_s: float) -> None:
        self._connect, self.name, self.wait_s = connect, name, wait_s
        self._open = ExitStack()
        self._client: Client | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self._client = None
        self._open.close()

    @contextmanager
    def open(self, work: UnitWork[UNIT, T]) -> Iterator[_ClusterWork[UNIT, T]]:
        portable, files = work.portable()
        parcel = CampaignParcel(bundle(files), pickle.dumps(portable), local_environment(), unit_limit_s(work))
        if self._client is None:
            self._client = self._open.enter_context(self._connect())
        with self._registered(self._client, parcel) as campaign:
            yield _ClusterWork(self, self._client, campaign, work)

    @contextmanager
    def _registered(self, client: Client, parcel: CampaignParcel) -> Iterator[str]:
        """Bring the work to all workers, and remove it from them at the end, with the processes that run its units."""
        name = f"fieldtwin-{uuid.uuid4().hex}"
        if client.status != "running":
            raise self.without_scheduler()
        try:
            client.register_plugin(CampaignPlugin(name, parcel))
        except ModuleNotFoundError as e:
            raise _without_fieldtwin(e) from e
        except (OSError, TimeoutError) as e:
            raise self.without_scheduler() from e
        try:
            yield name
        finally:
            with contextlib.suppress(
                Exception
            ):  # workers and scheduler may be gone, which the campaign has noticed by itself
                client.unregister_worker_plugin(name)

    def without_scheduler(self) -> ConnectionLost:
        return ConnectionLost("the scheduler is gone", where=self.name, hint=LEDGER_HINT)


@dataclass(frozen=True, slots=True)
class _ClusterWork(Generic[UNIT, T]):
    """Work that all workers have under the name `campaign`."""

    place: DaskPlace
    client: Client
    campaign: str
    work: UnitWork[UNIT, T]

    def threads(self) -> dict[str, int]:
        """Return the number of threads of each worker, by its address. Raises `ConnectionLost`."""
        if self.client.status != "running":
            raise self.place.without_scheduler()
        try:
            workers = self.client.scheduler_info(n_workers=-1)["workers"]
        except (OSError, TimeoutError) as e:
            raise self.place.without_scheduler() from e
        return {address: about["nthreads"] for address, about in workers.items()}

    def parallel_units(self) -> int:
        return max(1, sum(self.threads().values()))

    def run(
        self,
        units: Sequence[UNIT],
        on_ended: Callable[[Ended[UNIT, T]], None],
        repeats: Repeats[UNIT, T] | None = None,
    ) -> None:
        given = _Units(self, units, on_ended, repeats)
        try:
            given.run()
        finally:
            given.cancel()


@dataclass(frozen=True, slots=True)
class _Unit(Generic[UNIT, T]):
    """A unit with the scheduler. `first`: the earlier run that this one repeats. `submits` counts how often it was submitted."""

    unit: UNIT
    first: tuple[Ended[UNIT, T], str] | None = None
    submits: int = 1


class _Units(Generic[UNIT, T]):
    """Units of open work, until each of them has ended."""

    def __init__(
        self,
        opened: _ClusterWork[UNIT, T],
        units: Sequence[UNIT],
        on_ended: Callable[[Ended[UNIT, T]], None],
        repeats: Repeats[UNIT, T] | None,
    ) -> None:
        self._opened, self._work = opened, opened.work
        self._left, self._on_ended, self._repeats = iter(units), on_ended, repeats
        self._units: dict[Future, _Unit[UNIT, T]] = {}
        self._repeat_later: list[_Unit[UNIT, T]] = []
        self._ended: SimpleQueue[Future] = SimpleQueue()
        self._threads: dict[str, int] = {}

    def run(self) -> None:
        """Run all units. Raises `NotReproducible`, `Unreachable`, and the errors of the units."""
        place, without_worker_s = self._opened.place, 0.0
        since_look = 0
        while True:
            if since_look >= len(self._threads):
                self._threads = self._opened.threads()
                since_look = 0
            self._submit_repeats()
            self._submit_units()
            if not self._units:
                return
            try:
                self._take(self._ended.get(timeout=POLL_S))
                without_worker_s, since_look = 0.0, since_look + 1
            except Empty:
                since_look = len(self._threads)
                without_worker_s = 0.0 if self._threads else without_worker_s + POLL_S
            if without_worker_s >= place.wait_s:
                raise Unreachable(f"no worker for {place.wait_s:g} s", where=place.name, hint=LEDGER_HINT)

    def cancel(self) -> None:
        """Withdraw the units that have not ended."""
        with contextlib.suppress(Exception):  # the scheduler may be gone, and then there is nothing to withdraw
            self._opened.client.cancel(list(self._units), force=True)
        self._units.clear()

    def _submit_units(self) -> None:
        room = min(MAX_IN_FLIGHT, max(1, IN_FLIGHT_PER_THREAD * sum(self._threads.values())))
        for unit in islice(self._left, max(0, room - len(self._units))):
            self._submit(_Unit(unit))

    def _submit_repeats(self) -> None:
        """Submit the repetitions for which a different worker is available than in their first run."""
        waiting, self._repeat_later = self._repeat_later, []
        for unit in waiting:
            assert unit.first is not None
            others = [address for address in self._threads if address != unit.first[1]]
            if others:
                self._submit(unit, others)
            else:
                self._repeat_later.append(unit)

    def _submit(self, unit: _Unit[UNIT, T], workers: Sequence[str] | None = None) -> None:
        # the workers are a preference: a unit for workers that have all gone must not wait forever
        future = self._opened.client.submit(
            run_unit,
            self._opened.campaign,
            unit.unit,
            pure=False,
            workers=workers,
            allow_other_workers=workers is not None,
        )
        self._wait_for(future, unit)

    def _wait_for(self, future: Future, unit: _Unit[UNIT, T]) -> None:
        self._units[future] = unit
        future.add_done_callback(self._ended.put)

    def _take(self, future: Future) -> None:
        """Take what is known about a unit that has ended, or submit it again if its workers were lost."""
        unit = self._units.pop(future)
        try:
            answer = future.result(timeout=FETCH_S)
        except TimeoutError:  # its worker was lost with the result, so that the scheduler runs the unit again
            self._wait_for(future, unit)
        except (KilledWorker, CancelledError):
            self._lost(unit)
        except FieldtwinError:
            raise
        except ModuleNotFoundError as e:
            raise _without_fieldtwin(e) from e
        except Exception as e:
            raise Bug(f"a worker could not run seed {unit.unit}: {type(e).__name__}: {e}") from e
        else:
            self._take_answer(unit, answer)

    def _take_answer(self, unit: _Unit[UNIT, T], answer: Answer) -> None:
        if answer.data is None:
            self._unfinished(unit, answer.lost, answer.worker)
            return
        finished, result = pickle.loads(answer.data)
        if not finished:
            raise result
        ended = Ended(unit.unit, result, answer.worker)
        repeats = self._repeats
        if unit.first is None:
            self._on_ended(ended)
            if repeats is not None and unit.unit in repeats.sample and self._work.hash_of(result):
                self._repeat_later.append(_Unit(unit.unit, (ended, answer.address)))
            return
        first, address = unit.first
        if repeats is not None and address != answer.address:  # otherwise no other worker was left
            repeats.add(first, ended)

    def _lost(self, unit: _Unit[UNIT, T]) -> None:
        if unit.submits < MOST_SUBMITS:
            self._submit(replace(unit, submits=unit.submits + 1))
        else:
            self._unfinished(unit, f"its workers ended while it ran, {MOST_SUBMITS} times", "")

    def _unfinished(self, unit: _Unit[UNIT, T], reason: str, worker: str) -> None:
        if unit.first is None:
            self._on_ended(Ended(unit.unit, self._work.unfinished(unit.unit, reason), worker))


def _without_fieldtwin(error: ModuleNotFoundError) -> NotReproducible:
    return NotReproducible(
        f"the cluster has no module {error.name}",
        expected="the same fieldtwin on the scheduler and on all workers",
        hint="install the same wheel on all of them, for example with the same container image",
    )
