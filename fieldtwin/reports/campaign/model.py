"""The content of a report of a campaign. The ledgers from which it is made are read in `fieldtwin.run.campaigns`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from fieldtwin.plc.st.coverage.places import Coverage
from fieldtwin.results.model import Verdict


@dataclass(frozen=True, slots=True)
class CampaignRun:
    """One run. `hours` are virtual; `ended_s` is its end in seconds since 1970 (UTC), 0 if it is not known; `took_s` is its wall
    time in seconds. `trace` is the file of its trace, empty if none was kept.
    """

    seed: int
    ok: bool
    hours: float
    errors: tuple[str, ...] = ()
    reproduce: str = ""
    sha256: str = ""
    checked: int = 0
    wrong: int = 0
    ended_s: float = 0.0
    took_s: float = 0.0
    worker: str = ""
    trace: str = ""

    @property
    def cause(self) -> str:
        """Return the first error of a failed run."""
        return self.errors[0] if self.errors else "no reason is recorded"


@dataclass(frozen=True, slots=True)
class FailureGroup:
    """Failed runs with the same cause. `cause` is that of the first of `runs`, which are ordered by seed."""

    cause: str
    runs: Sequence[CampaignRun]

    @property
    def traced(self) -> list[CampaignRun]:
        """Return the runs whose traces were kept."""
        return [run for run in self.runs if run.trace]


@dataclass(frozen=True, slots=True)
class CampaignResult:
    """The runs of one campaign, ordered by seed, each seed once. `what` is the fingerprint of files and options.

    `missing`: seeds of the campaign without a run. `different`: seeds with several results. `untested`: faults were chosen, and
    none took effect. `inconclusive`: further reasons why passed runs prove nothing. `coverage`: virtual hours, rising, each with
    the number of different situations that the runs until then reached; empty if it is not known. `reproduce`: the command of the
    campaign, empty if it is not known.
    """

    system: str
    what: str
    version: str
    runs: Sequence[CampaignRun]
    groups: Sequence[FailureGroup] = ()
    missing: Sequence[int] = ()
    different: Sequence[int] = ()
    untested: bool = False
    ledgers: Sequence[str] = ()
    reproduce: str = ""
    coverage: Sequence[tuple[float, int]] = ()
    inconclusive: Sequence[str] = ()
    programs: Coverage | None = None
    """The coverage of Structured Text by the runs that measured it, whose number is `measured`."""
    measured: int = 0

    @property
    def failed(self) -> list[CampaignRun]:
        return [run for run in self.runs if not run.ok]

    @property
    def hours(self) -> float:
        """Return the sum of the virtual hours."""
        return sum(run.hours for run in self.runs)

    @property
    def title(self) -> str:
        return self.system or f"campaign {self.what}"

    @property
    def verdict(self) -> Verdict:
        """Return FAILED if a run failed or was not reproduced, INCONCLUSIVE if something was not tested, else PASSED."""
        if self.failed or self.different:
            return Verdict.FAILED
        untested = self.missing or self.untested or self.inconclusive or not self.runs
        return Verdict.INCONCLUSIVE if untested else Verdict.PASSED
