"""Run a scenario with many seeds, in virtual time, with or without faults that each seed chooses.

With random faults the steps only drive the system; the verdict depends on the rules that hold all the time: the
scenario's `always`, `never` and `within`, the invariants of the system file, that every part runs, and `judge: run`.
The same seed always gives the same run.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from fieldtwin.__about__ import __version__
from fieldtwin.emulators.faults.schema import seconds
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.plc.st.coverage.compact import CompactCoverage
from fieldtwin.results.model import CheckResult, ScenarioResult, Verdict
from fieldtwin.run.campaigns.coverage import joined
from fieldtwin.run.campaigns.coverage_collector import CoverageCollector
from fieldtwin.run.campaigns.ledger import LedgerEntry
from fieldtwin.run.campaigns.many_seeds import fingerprint
from fieldtwin.run.places.bundle import files_of, profile_folders, relative
from fieldtwin.run.places.place import Ended
from fieldtwin.run.targets.virtual_scenario import group_of, reproduce, run_virtual
from fieldtwin.run.virtual.fault_schedule import RandomFaults, random_schedule
from fieldtwin.run.virtual.guided_faults import guide_of
from fieldtwin.run.virtual.program_coverage import ProgramCoverage
from fieldtwin.run.virtual.run import texts_of
from fieldtwin.scenarios.judging.runner import ByChance
from fieldtwin.scenarios.language.about import result_of
from fieldtwin.scenarios.language.form import Scenario, load_scenario

SHORTEST_S = 600.0
"""Default duration in seconds of a run with random faults."""
MOST_REASON = 2000
"""Largest number of characters of the reason of a failure in the ledger."""
_EFFECTS = ("fault ", "set ")
"""The beginnings of the numbers of checks that a run lists only if a fault or a value had no effect."""
_BY_RUN = ("running", "refused", "judge")
"""The checks of a whole run, whose text does not name the cause of a failure; `got` does."""


@dataclass(frozen=True)
class Campaign:
    """A scenario file, and the options from which each seed chooses its faults.

    `duration_s` 0: the scenario's maximum duration, at least `SHORTEST_S`.
    """

    path: Path
    profiles: tuple[Path, ...] = ()
    random_faults: RandomFaults | None = None
    duration_s: float = 0.0
    words: tuple[str, ...] = ()
    """The command-line options, apart from the seed, that reproduce a seed's run."""

    def check(self) -> Scenario:
        """Return the scenario.

        Raise `UsageError` if it has no rule that random faults could break, or no target for faults.
        """
        scenario = load_scenario(self.path, self.profiles)
        if self.random_faults is None:
            return scenario
        self.random_faults.check(group_of(scenario))
        form = scenario.form
        if not (form.always or form.never or form.within or form.judge or scenario.invariants):
            raise UsageError(
                "random faults cannot fail this scenario: its steps are not checked under random faults",
                where=str(self.path),
                expected="always, never, within or judge in the scenario, or invariants in the system file",
            )
        return scenario

    def length_s(self, scenario: Scenario) -> float:
        """Return the duration in seconds of a run with random faults."""
        return self.duration_s or max(SHORTEST_S, longest_s(scenario))


def longest_s(scenario: Scenario) -> float:
    """Return how long the steps of a scenario may take, in seconds."""
    total_s = 0.0
    for step in scenario.form.steps:
        if step.pause is not None:
            total_s += seconds(step.pause)
        if step.wait is not None:
            total_s += seconds(step.wait.within)
        if step.expect is not None:
            total_s += sum(seconds(t) for t in (step.expect.within, step.expect.during) if t is not None)
    return total_s


def schedule(campaign: Campaign, seed: int) -> tuple[dict[str, Any], ...]:
    """Return the faults that a seed chooses. Guided faults are known only after a run, so it is made again."""
    scenario, wanted = campaign.check(), campaign.random_faults
    if wanted is None:
        return ()
    length_s = campaign.length_s(scenario)
    drawn = random_schedule(group_of(scenario), seed, length_s, wanted)
    guide = guide_of(group_of(scenario), seed, length_s, wanted)
    if guide is None:
        return drawn
    run_virtual(scenario, seed, by_chance=ByChance(drawn, length_s), guide=guide)
    return (*drawn, *guide.chosen)


def run_seed(
    campaign: Campaign,
    seed: int,
    faults: Sequence[dict[str, Any]] | None = None,
    trace: Path | None = None,
    most_trace_bytes: int | None = None,
    *,
    measures: bool = False,
) -> ScenarioResult:
    """Run the scenario with a seed; if `faults` are given, they replace the faults that the seed chooses.

    `trace` is a file for every event, limited by `most_trace_bytes`. `measures`: also measure the coverage of Structured Text.
    """
    scenario = campaign.check()
    by_chance, guide, wanted = None, None, campaign.random_faults
    if wanted is not None:
        group, length_s = group_of(scenario), campaign.length_s(scenario)
        if faults is None:
            faults = random_schedule(group, seed, length_s, wanted)
            guide = guide_of(group, seed, length_s, wanted)
        by_chance = ByChance(tuple(faults), length_s)
    seen, programs = CoverageCollector(), ProgramCoverage(wanted=measures)
    with programs.active():
        result = run_virtual(
            scenario, seed, trace, by_chance, guide=guide, most_trace_bytes=most_trace_bytes, watch=seen.listen
        )
    result = replace(result, coverage=seen.coverage.text(), programs=programs.compact())
    if by_chance is None:
        return result
    return replace(result, reproduce=reproduce(scenario, *campaign.words, "--seeds", str(seed)))


def slim_run(
    campaign: Campaign, seed: int, faults: Sequence[dict[str, Any]] | None = None, *, measures: bool = False
) -> ScenarioResult:
    """Run a seed as `run_seed` does and drop the events of its run, because the events of two hundred seeds would not fit into
    memory. To see them, run the seed again.
    """
    return replace(run_seed(campaign, seed, faults, measures=measures), trace=(), dropped=0)


@dataclass(frozen=True, slots=True)
class ScenarioRuns:
    """Runs of a scenario with many seeds, as work for a place. `measures`: the runs measure the coverage of Structured Text."""

    campaign: Campaign
    measures: bool = False

    @property
    def virtual_s(self) -> float:
        return self.campaign.length_s(self.campaign.check())

    def run(self, seed: int) -> ScenarioResult:
        return slim_run(self.campaign, seed, measures=self.measures)

    def run_traced(self, seed: int, trace: Path, most_bytes: int) -> ScenarioResult:
        return run_seed(self.campaign, seed, trace=trace, most_trace_bytes=most_bytes)

    def faults_of(self, seed: int) -> Sequence[dict[str, Any]]:
        return schedule(self.campaign, seed)

    def run_with(self, seed: int, faults: Sequence[dict[str, Any]]) -> ScenarioResult:
        return slim_run(self.campaign, seed, faults)

    def errors_of(self, result: ScenarioResult) -> Sequence[str]:
        return broken_by(result)

    def unfinished(self, seed: int, reason: str) -> ScenarioResult:
        text = f"the run did not finish: {reason}"
        scenario = self.campaign.check()
        again = reproduce(scenario, *self.campaign.words, "--seeds", str(seed))
        return replace(
            result_of(scenario, "virtual", Verdict.ERROR, checks=(), reason=text), seed=seed, reproduce=again
        )

    def hash_of(self, result: ScenarioResult) -> str:
        return result.trace_hash

    def portable(self) -> tuple[ScenarioRuns, tuple[Path, ...]]:
        campaign = self.campaign
        files = files_of(group_of(campaign.check()), campaign.profiles)
        moved = replace(campaign, path=relative(campaign.path), profiles=profile_folders(campaign.profiles))
        return ScenarioRuns(moved, self.measures), (campaign.path, *files)


def what_tests(campaign: Campaign) -> str:
    """Return a fingerprint of a campaign without its seeds, from the contents of its files and its options."""
    scenario = campaign.check()
    options = (campaign.random_faults, campaign.length_s(scenario))
    return fingerprint(*texts_of(group_of(scenario)), campaign.path.read_text(encoding="utf-8"), repr(options))


def scenario_entry(what: str, ended: Ended[int, ScenarioResult], ended_s: float) -> LedgerEntry:
    """Return the line of the ledger for a run. `what` is the campaign's fingerprint, `ended_s` the time since 1970 in seconds."""
    result = ended.result
    checks = [check for check in result.checks if not check.vacuous]
    passed = result.verdict is Verdict.PASSED
    programs = result.programs or CompactCoverage()
    return LedgerEntry(
        what,
        __version__,
        ended.unit,
        result.simulated_s / 3600,
        passed,
        len(checks),
        sum(check.verdict.bad for check in checks),
        result.trace_hash,
        () if passed else (result.why[:MOST_REASON],),
        system=result.case,
        reproduce="" if passed else result.reproduce,
        ended_s=round(ended_s, 3),
        took_s=round(result.took_s, 3),
        worker=ended.worker,
        coverage=result.coverage,
        verdict=result.verdict.value,
        judged=tuple(check.number for check in checks if not check.number.isdigit()),
        struck=sum(fault.struck for fault in result.faults),
        places=programs.places,
        executed=programs.executed,
    )


def verdict_of(
    campaign: Campaign,
    results: Sequence[ScenarioResult],
    chosen: Sequence[str],
    before: Sequence[LedgerEntry] = (),
    more: Sequence[CheckResult] = (),
) -> ScenarioResult:
    """Return the result of the campaign: how many seeds checked each rule, and how often faults took effect.

    It is FAILED if a seed is. It is INCONCLUSIVE if a seed is, if no seed checked a rule of the scenario, or if no
    fault took effect. `chosen`: the command-line options that choose these seeds. `before`: runs of a ledger, which count like
    `results`. `more`: further checks of the campaign.
    """
    scenario = load_scenario(campaign.path, campaign.profiles)
    checks = [*more, *_seeds_check(results, before), *_rule_checks(results, before)]
    if campaign.random_faults is not None:
        checks.append(_faults_check(results, before))
    verdicts = [check.verdict for check in checks]
    worst = next((v for v in (Verdict.FAILED, Verdict.INCONCLUSIVE) if v in verdicts), Verdict.PASSED)
    first = next((check for check in checks if check.verdict is worst), None)
    told = f"{first.number}: {first.text}: {first.got}" if first is not None and worst is not Verdict.PASSED else ""
    made = result_of(scenario, "virtual", worst, checks=tuple(checks), reason=told)
    return replace(
        made,
        name=f"{made.name} [{len(results) + len(before)} seeds]",
        reproduce=reproduce(scenario, *campaign.words, *chosen),
        simulated_s=sum(result.simulated_s for result in results),
        took_s=sum(result.took_s for result in results),
        coverage=joined([*(one.coverage for one in results), *(one.coverage for one in before)]).text(),
    )


def _seeds_check(results: Sequence[ScenarioResult], before: Sequence[LedgerEntry]) -> list[CheckResult]:
    """Return the check that every seed passed."""
    ended = [(result.seed or 0, result.verdict) for result in results]
    ended += [(entry.seed, Verdict(entry.verdict)) for entry in before]
    bad = sorted((seed, verdict.value) for seed, verdict in ended if verdict is not Verdict.PASSED)
    failed = any(verdict.bad for _, verdict in ended)
    verdict = Verdict.FAILED if failed else Verdict.INCONCLUSIVE if bad else Verdict.PASSED
    named = ", ".join(f"{seed} ({word})" for seed, word in bad[:10]) + (", ..." if len(bad) > 10 else "")
    recorded = f"; {len(before)} of them by the ledger" if before else ""
    got = f"{len(ended) - len(bad)} of {len(ended)} passed{recorded}" + (f"; not: {named}" if bad else "")
    return [CheckResult("seeds", "every seed passes", verdict, expected="all of them" if bad else "", got=got)]


def _rule_checks(results: Sequence[ScenarioResult], before: Sequence[LedgerEntry]) -> list[CheckResult]:
    """Return a check for each rule.

    A rule that no seed checked is INCONCLUSIVE, unless it is an invariant of the system file.
    """
    found: dict[str, list[CheckResult]] = {}
    for result in results:
        for check in result.checks:
            if not check.number.isdigit():
                found.setdefault(check.number, []).append(check)
    checks = []
    for number, every in found.items():
        first = next((one for one in every if one.verdict.bad), every[0])
        broken = sum(one.verdict.bad for one in every)
        puts_in = number.startswith(_EFFECTS)  # listed only if it had no effect
        judged = len(results) - len(every) if puts_in else sum(not one.vacuous for one in every)
        judged += sum(number in entry.judged for entry in before)
        verdict = Verdict.FAILED if broken else Verdict.PASSED
        if not judged and "invariant" not in number:
            verdict = Verdict.INCONCLUSIVE
        got = f"checked with {judged} of {len(results) + len(before)} seeds, broken with {broken}"
        checks.append(CheckResult(number, first.text, verdict, got=got, where=first.where, names=first.names))
    return checks


def _faults_check(results: Sequence[ScenarioResult], before: Sequence[LedgerEntry]) -> CheckResult:
    """Return the check that at least one fault took effect, with the number of times by name of the fault."""
    names = sorted({fault.name for result in results for fault in result.faults})
    struck = {n: [fault.struck for result in results for fault in result.faults if fault.name == n] for n in names}
    parts = [f"{name} {len(each)} (took effect {sum(each)} times)" for name, each in struck.items()]
    got = f"{sum(map(len, struck.values()))} injected: {', '.join(parts)}" if parts else "none was injected"
    recorded = sum(entry.struck for entry in before)
    got += f"; by the ledger, faults took effect {recorded} times before" if before else ""
    verdict = Verdict.PASSED if recorded or any(map(sum, struck.values())) else Verdict.INCONCLUSIVE
    return CheckResult("faults", "random faults are injected", verdict, got=got)


def broken_by(result: ScenarioResult) -> list[str]:
    """Return the failures of a run without their places in the file, so that they can be compared with those of a
    scenario that was written to reproduce the run.
    """
    told: list[str] = []
    for check in result.checks:
        if not check.verdict.bad:
            continue
        if check.number in _BY_RUN:
            told += [f"{check.number}: {part}" for part in check.got.split("; ")]
        else:
            told.append(check.text)
    return told
