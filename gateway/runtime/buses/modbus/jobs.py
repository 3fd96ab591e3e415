"""The queue of requests that a Modbus bus carries out before its next poll: writes, and requests of other services."""

from __future__ import annotations

from collections import deque
from collections.abc import Awaitable, Callable
from dataclasses import dataclass

from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.errors import FieldtwinError
from fieldtwin.gateway.devices.register_device import RegisterDriver
from fieldtwin.gateway.protocols.modbus.unit_timing import UnitTiming

MAX_JOBS = 256


@dataclass
class BusJob:
    """A request to carry out on the bus before the next poll. `done` is called once, with None or the error."""

    driver: RegisterDriver
    run: Callable[[], Awaitable[None]]
    done: Callable[[FieldtwinError | None], None]


class JobQueue:
    """At most `MAX_JOBS` jobs, in the order in which they were added."""

    def __init__(self) -> None:
        self._jobs: deque[BusJob] = deque()

    def __len__(self) -> int:
        return len(self._jobs)

    @property
    def full(self) -> bool:
        return len(self._jobs) >= MAX_JOBS

    def add(self, job: BusJob) -> None:
        self._jobs.append(job)

    def fail_all(self, error: FieldtwinError) -> None:
        """Remove all jobs; each ends with `error`."""
        while self._jobs:
            self._jobs.popleft().done(error)

    def next(self, units: UnitTiming, now_ns: int) -> tuple[BusJob | None, int]:
        """Return the first queued job whose unit needs no more pause, or None, and the time at which to check again."""
        wake_ns = now_ns + NS_PER_S
        for place, job in enumerate(self._jobs):
            ready_ns = units.spaced_ns(job.driver.config.address)
            if ready_ns <= now_ns:
                del self._jobs[place]
                return job, now_ns
            wake_ns = min(wake_ns, ready_ns)
        return None, wake_ns
