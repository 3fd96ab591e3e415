"""The reports of a campaign from the entries of its ledgers: the HTML report, and JUnit with a test case for each seed."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from types import MappingProxyType

from fieldtwin.reports.campaign.model import CampaignResult, CampaignRun, FailureGroup
from fieldtwin.results.model import Report, ScenarioResult, Verdict
from fieldtwin.run.campaigns.coverage import Coverage
from fieldtwin.run.campaigns.ledger import LedgerEntry, unfinished_left
from fieldtwin.run.campaigns.merging import Runs
from fieldtwin.run.campaigns.shrink import kind_of

NOT_REPRODUCED = "several computers ran this seed with different results, which is a defect"
UNTESTED = "no fault took effect in any run, so nothing was tested with faults: try a longer --for"
MISSING = "no ledger contains a run with this seed"


def campaign_of(
    runs: Runs,
    expected: frozenset[int] = frozenset(),
    ledgers: Sequence[str] = (),
    reproduce: str = "",
    *,
    untested: bool = False,
    with_coverage: bool = True,
    traces: Mapping[int, str] = MappingProxyType({}),
    inconclusive: Sequence[str] = (),
) -> CampaignResult:
    """Return the result of a campaign. `expected`: the seeds that it should have, empty if they are not known. `traces`: the
    files of the traces of failed runs, by seed. `inconclusive`: reasons why passed runs prove nothing.

    Raises `FileInvalid` for an invalid coverage. Without coverage a result of 100,000 runs needs a tenth of the time.
    """
    failures_last = sorted(
        unfinished_left(runs.entries), key=lambda entry: not entry.ok
    )  # of several results, a failure is shown
    of_seed = {entry.seed: entry for entry in failures_last}
    every = [_run(of_seed[seed], traces.get(seed, "")) for seed in sorted(of_seed)]
    programs, measured = runs.programs if with_coverage else (None, 0)
    return CampaignResult(
        next((entry.system for entry in runs.entries if entry.system), ""),
        runs.what,
        runs.version,
        every,
        groups_of([run for run in every if not run.ok]),
        sorted(expected - runs.seeds),
        runs.different,
        untested,
        ledgers,
        reproduce,
        coverage_of(of_seed.values()) if with_coverage else (),
        inconclusive,
        programs,
        measured,
    )


def coverage_of(entries: Iterable[LedgerEntry]) -> list[tuple[float, int]]:
    """Return the virtual hours, each with the number of different situations that the runs until then reached, in the order in
    which the runs ended. Raises `FileInvalid`.
    """
    hours, seen, points = 0.0, set[int](), list[tuple[float, int]]()
    for entry in sorted(entries, key=lambda entry: (entry.ended_s, entry.seed)):
        hours += entry.hours
        before = len(seen)
        seen |= Coverage.parse(entry.coverage).elements
        if len(seen) > before:
            points.append((hours, len(seen)))
    return [*points, (hours, len(seen))] if seen else []


def _run(entry: LedgerEntry, trace: str) -> CampaignRun:
    return CampaignRun(
        entry.seed,
        entry.ok,
        entry.hours,
        entry.errors,
        entry.reproduce,
        entry.sha256,
        entry.checked,
        entry.wrong,
        entry.ended_s,
        entry.took_s,
        entry.worker,
        trace,
    )


def groups_of(failed: Sequence[CampaignRun]) -> list[FailureGroup]:
    """Return failed runs by the kind of their first error; the largest group first."""
    found: dict[str, list[CampaignRun]] = {}
    for run in failed:
        found.setdefault(kind_of(run.cause), []).append(run)
    groups = [FailureGroup(own[0].cause, own) for own in found.values()]
    return sorted(groups, key=lambda group: (-len(group.runs), group.runs[0].seed))


def junit_report(campaigns: Sequence[CampaignResult]) -> Report:
    """Return the campaigns for JUnit: a test case for each seed, also for a missing one."""
    cases: list[ScenarioResult] = []
    for campaign in campaigns:
        different = frozenset(campaign.different)
        cases += [_case(campaign, run, run.seed in different) for run in campaign.runs]
        cases += [
            ScenarioResult(campaign.title, Verdict.INCONCLUSIVE, target="virtual", seed=seed, reason=MISSING)
            for seed in campaign.missing
        ]
        if campaign.untested:
            cases.append(ScenarioResult(campaign.title, Verdict.INCONCLUSIVE, target="virtual", reason=UNTESTED))
    versions = {"fieldtwin": campaigns[0].version} if campaigns else {}
    reproduce = campaigns[0].reproduce if campaigns else ""
    return Report("campaign", cases, target="virtual", reproduce=reproduce, versions=versions)


def _case(campaign: CampaignResult, run: CampaignRun, different: bool) -> ScenarioResult:
    verdict = Verdict.FAILED if different or not run.ok else Verdict.PASSED
    reason = NOT_REPRODUCED if different else "" if run.ok else "; ".join(run.errors) or run.cause
    return ScenarioResult(
        campaign.title,
        verdict,
        target="virtual",
        seed=run.seed,
        reason=reason,
        reproduce=run.reproduce,
        simulated_s=run.hours * 3600,
        took_s=run.took_s,
        trace_hash=run.sha256,
    )
