"""Run several plans in parallel, in processes on this computer."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Future, as_completed

from fieldtwin.run.processes.workers import Workers
from fieldtwin.run.what_if.fork import Fork, Progress, answer
from fieldtwin.run.what_if.outcome import PlanOutcome
from fieldtwin.run.what_if.plan import WhatIfPlan


def answers(
    fork: Fork, plans: Sequence[WhatIfPlan], jobs: int, progress: Progress = lambda outcome: None
) -> list[PlanOutcome]:
    """Return the outcome of each plan, in the order of `plans`. One job or plan runs in this process. Raises like `answer`."""
    if jobs <= 1 or len(plans) == 1:
        found = []
        for plan in plans:
            found.append(answer(fork, plan))
            progress(found[-1])
        return found
    with Workers(min(jobs, len(plans))) as pool:
        waiting: dict[Future[PlanOutcome], int] = {pool.submit(answer, fork, plan): n for n, plan in enumerate(plans)}
        outcomes: dict[int, PlanOutcome] = {}
        for done in as_completed(waiting):
            outcomes[waiting[done]] = done.result()
            progress(done.result())
    return [outcomes[n] for n in range(len(plans))]
