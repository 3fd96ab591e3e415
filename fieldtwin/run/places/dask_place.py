"""The workers of a Dask cluster as a place for the units of a campaign.

Dask's scheduler distributes the units and gives those of a lost worker to a different one. This module keeps a bounded number of
units with the scheduler, counts each seed once, and runs a sample of the seeds again on a different worker.
"""

from __future__ import annotations

import contextlib
import pickle
import uuid
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass, replace
from queue import Empty, SimpleQueue
from types import TracebackType
from typing import Generic, Self

from distributed import Client, Future, KilledWorker

from fieldtwin.gateway.core.errors import Bug, ConnectionLost, FieldtwinError, Unreachable
from fieldtwin.run.places.bundle import bundle
from fieldtwin.run.places.dask_worker import Answer, CampaignParcel, CampaignPlugin, run_unit
from fieldtwin.run.places.environment import NotReproducible, local_environment
from fieldtwin.run.places.place import Ended, Repeats, SeedWork, T, unit_limit_s
from fieldtwin.run.places.sample import sample_of

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

    def run(
        self, work: SeedWork[T], seeds: Sequence[int], on_ended: Callable[[Ended[T]], None], repeats: Repeats[T]
    ) -> None:
        if not seeds:
            return
        portable, files = work.portable()
        parcel = CampaignParcel(bundle(files), pickle.dumps(portable), local_environment(), unit_limit_s(work))
        if self._client is None:
            self._client = self._open.enter_context(self._connect())
        with _registered(self._client, parcel) as campaign:
            units = _Units(self, self._client, campaign, work, seeds, on_ended, repeats)
            try:
                units.run()
            finally:
                units.cancel()


@contextmanager
def _registered(client: Client, parcel: CampaignParcel) -> Iterator[str]:
    """Bring the campaign to all workers, and remove it from them at the end, with the processes that run its units."""
    name = f"fieldtwin-{uuid.uuid4().hex}"
    try:
        client.register_plugin(CampaignPlugin(name, parcel))
    except ModuleNotFoundError as e:
        raise _without_fieldtwin(e) from e
    try:
        yield name
    finally:
        with contextlib.suppress(
            Exception
        ):  # workers and scheduler may be gone, which the campaign has noticed by itself
            client.unregister_worker_plugin(name)


@dataclass(frozen=True, slots=True)
class _Unit(Generic[T]):
    """A unit with the scheduler. `first`: the earlier run that this one repeats. `submits` counts how often it was submitted."""

    seed: int
    first: tuple[Ended[T], str] | None = None
    submits: int = 1


class _Units(Generic[T]):
    """The units of a running campaign."""

    def __init__(
        self,
        place: DaskPlace,
        client: Client,
        campaign: str,
        work: SeedWork[T],
        seeds: Sequence[int],
        on_ended: Callable[[Ended[T]], None],
        repeats: Repeats[T],
    ) -> None:
        self._place, self._client, self._campaign, self._work = place, client, campaign, work
        self._left, self._on_ended, self._repeats = iter(seeds), on_ended, repeats
        self._sample = sample_of(seeds)
        self._units: dict[Future, _Unit[T]] = {}
        self._repeat_later: list[_Unit[T]] = []
        self._ended: SimpleQueue[Future] = SimpleQueue()
        self._threads: dict[str, int] = {}

    def run(self) -> None:
        """Run all units. Raises `NotReproducible`, `Unreachable`, and the errors of the units."""
        without_worker_s = 0.0
        since_look = 0
        while True:
            if since_look >= len(self._threads):
                self._look_at_workers()
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
            if without_worker_s >= self._place.wait_s:
                raise Unreachable(f"no worker for {self._place.wait_s:g} s", where=self._place.name, hint=LEDGER_HINT)

    def cancel(self) -> None:
        """Withdraw the units that have not ended."""
        with contextlib.suppress(Exception):  # the scheduler may be gone, and then there is nothing to withdraw
            self._client.cancel(list(self._units), force=True)
        self._units.clear()

    def _look_at_workers(self) -> None:
        if self._client.status != "running":
            raise self._without_scheduler()
        try:
            workers = self._client.scheduler_info(n_workers=-1)["workers"]
        except (OSError, TimeoutError) as e:
            raise self._without_scheduler() from e
        self._threads = {address: about["nthreads"] for address, about in workers.items()}

    def _without_scheduler(self) -> ConnectionLost:
        return ConnectionLost("the scheduler is gone", where=self._place.name, hint=LEDGER_HINT)

    def _submit_units(self) -> None:
        room = min(MAX_IN_FLIGHT, max(1, IN_FLIGHT_PER_THREAD * sum(self._threads.values())))
        while len(self._units) < room and (seed := next(self._left, None)) is not None:
            self._submit(_Unit(seed))

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

    def _submit(self, unit: _Unit[T], workers: Sequence[str] | None = None) -> None:
        # the workers are a preference: a unit for workers that have all gone must not wait for ever
        future = self._client.submit(
            run_unit,
            self._campaign,
            unit.seed,
            pure=False,
            workers=workers,
            allow_other_workers=workers is not None,
        )
        self._wait_for(future, unit)

    def _wait_for(self, future: Future, unit: _Unit[T]) -> None:
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
            raise Bug(f"a worker could not run seed {unit.seed}: {type(e).__name__}: {e}") from e
        else:
            self._take_answer(unit, answer)

    def _take_answer(self, unit: _Unit[T], answer: Answer) -> None:
        if answer.data is None:
            self._unfinished(unit, answer.lost, answer.worker)
            return
        finished, result = pickle.loads(answer.data)
        if not finished:
            raise result
        ended = Ended(unit.seed, result, answer.worker)
        if unit.first is None:
            self._on_ended(ended)
            if unit.seed in self._sample and self._work.hash_of(result):
                self._repeat_later.append(_Unit(unit.seed, (ended, answer.address)))
            return
        first, address = unit.first
        if address != answer.address:  # otherwise no other worker was left
            self._repeats.add(first, ended)

    def _lost(self, unit: _Unit[T]) -> None:
        if unit.submits < MOST_SUBMITS:
            self._submit(replace(unit, submits=unit.submits + 1))
        else:
            self._unfinished(unit, f"its workers ended while it ran, {MOST_SUBMITS} times", "")

    def _unfinished(self, unit: _Unit[T], reason: str, worker: str) -> None:
        if unit.first is None:
            self._on_ended(Ended(unit.seed, self._work.unfinished(unit.seed, reason), worker))


def _without_fieldtwin(error: ModuleNotFoundError) -> NotReproducible:
    return NotReproducible(
        f"the cluster has no module {error.name}",
        expected="the same fieldtwin on the scheduler and on all workers",
        hint="install the same wheel on all of them, for example with the same container image",
    )
