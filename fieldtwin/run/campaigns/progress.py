"""The progress of a campaign: counts, rates and the first failures, for views of a campaign in progress."""

from __future__ import annotations

from dataclasses import dataclass, field

from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.run.campaigns.coverage import Coverage

MOST_FAILURES = 10
"""Largest number of failures that are kept with their cause; further ones are only counted."""


@dataclass(frozen=True, slots=True)
class Failure:
    """A failed run: its seed, and the cause as one line."""

    seed: int
    cause: str


@dataclass(slots=True)
class CampaignProgress:
    """The runs of a campaign that have ended, of `total`. `began_ns` and each `now_ns` are times of a monotonic clock, in ns."""

    title: str
    total: int
    began_ns: int
    done: int = 0
    failed: int = 0
    hours: float = 0.0
    """Virtual hours of the runs that have ended."""
    failures: list[Failure] = field(default_factory=list)
    coverage: Coverage = field(default_factory=Coverage)
    """The situations that the runs have reached."""

    def ended(self, seed: int, hours: float, cause: str | None, coverage: str = "") -> None:
        """Count a run that has ended. `hours`: its virtual hours. `cause`: None if the run passed. `coverage`: its text."""
        self.coverage |= Coverage.parse(coverage)
        self.done += 1
        self.hours += hours
        if cause is not None:
            self.failed += 1
            if len(self.failures) < MOST_FAILURES:
                self.failures.append(Failure(seed, cause))

    def elapsed_s(self, now_ns: int) -> float:
        return max(now_ns - self.began_ns, 1) / NS_PER_S

    def runs_per_s(self, now_ns: int) -> float:
        return self.done / self.elapsed_s(now_ns)

    def remaining_s(self, now_ns: int) -> float | None:
        """Return the wall time in seconds until the last run ends, at the present rate; None before the first run has ended."""
        return (self.total - self.done) / self.runs_per_s(now_ns) if self.done else None

    def hours_per_hour(self, now_ns: int) -> float:
        """Return the virtual hours for each hour of wall time."""
        return self.hours / (self.elapsed_s(now_ns) / 3600)
