"""The workers of a campaign, and when their runs ended."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from fieldtwin.reports.campaign.model import CampaignRun

BINS = 90
"""Number of equal intervals of wall time in which the ended runs are counted."""


@dataclass(frozen=True, slots=True)
class Worker:
    """The runs of one process. `busy_s` is the sum of their wall times in seconds."""

    name: str
    runs: int
    failed: int
    hours: float
    busy_s: float


def workers_of(runs: Sequence[CampaignRun]) -> list[Worker]:
    """Return the workers, ordered by name. Runs without a recorded worker are left out."""
    of: dict[str, list[CampaignRun]] = {}
    for run in runs:
        if run.worker:
            of.setdefault(run.worker, []).append(run)
    return [
        Worker(name, len(own), sum(not r.ok for r in own), sum(r.hours for r in own), sum(r.took_s for r in own))
        for name, own in sorted(of.items())
    ]


@dataclass(frozen=True, slots=True)
class Timeline:
    """The ended runs over wall time: `passed` and `failed` have a count for each of `BINS` intervals from `start_s` to `end_s`,
    which are seconds since 1970 (UTC).
    """

    start_s: float
    end_s: float
    passed: Sequence[int]
    failed: Sequence[int]

    @property
    def most(self) -> int:
        """Return the largest number of runs that ended in one interval."""
        return max(a + b for a, b in zip(self.passed, self.failed, strict=True))

    @property
    def bin_s(self) -> float:
        return (self.end_s - self.start_s) / BINS


def timeline_of(runs: Sequence[CampaignRun]) -> Timeline | None:
    """Return the timeline of the runs whose end is recorded; None if that of no run is."""
    known = [run for run in runs if run.ended_s]
    if not known:
        return None
    start_s = min(run.ended_s - run.took_s for run in known)
    end_s = max(max(run.ended_s for run in known), start_s + 1e-3)
    counts = {True: [0] * BINS, False: [0] * BINS}
    for run in known:
        place = int((run.ended_s - start_s) / (end_s - start_s) * BINS)
        counts[run.ok][min(max(place, 0), BINS - 1)] += 1
    return Timeline(start_s, end_s, counts[True], counts[False])
