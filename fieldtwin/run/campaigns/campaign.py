"""Run a scenario with many seeds, in virtual time, with or without faults that each seed chooses.

With random faults the steps only drive the system; the verdict depends on the rules that hold all the time: the
scenario's `always`, `never` and `within`, the invariants of the system file, that every part runs, and `judge: run`.
The same seed always gives the same run.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from fieldtwin.emulators.faults.schema import seconds
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.results.model import CheckResult, ScenarioResult, Verdict
from fieldtwin.run.processes.workers import each
from fieldtwin.run.targets.virtual_scenario import group_of, reproduce, run_virtual
from fieldtwin.run.virtual.fault_schedule import RandomFaults, random_schedule
from fieldtwin.scenarios.judging.runner import ByChance
from fieldtwin.scenarios.language.about import result_of
from fieldtwin.scenarios.language.form import Scenario, load_scenario

SHORTEST_S = 600.0
"""Default duration in seconds of a run with random faults."""
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


def schedule(campaign: Campaign, scenario: Scenario, seed: int) -> tuple[dict[str, Any], ...]:
    """Return the faults that a seed chooses."""
    wanted, length_s = campaign.random_faults, campaign.length_s(scenario)
    if wanted is None:
        return ()
    return random_schedule(group_of(scenario), seed, length_s, wanted)


def run_seed(campaign: Campaign, seed: int, faults: Sequence[dict[str, Any]] | None = None) -> ScenarioResult:
    """Run the scenario with a seed; if `faults` are given, they replace the faults that the seed chooses."""
    scenario = campaign.check()
    by_chance = None
    if campaign.random_faults is not None:
        chosen = schedule(campaign, scenario, seed) if faults is None else tuple(faults)
        by_chance = ByChance(chosen, campaign.length_s(scenario))
    result = run_virtual(scenario, seed, by_chance=by_chance)
    if by_chance is None:
        return result
    return replace(result, reproduce=reproduce(scenario, *campaign.words, "--seeds", str(seed)))


def _slim(campaign: Campaign, seed: int) -> ScenarioResult:
    """Run a seed and drop the events of its run, because the events of two hundred seeds would not fit into memory. To see
    them, run the seed again.
    """
    result = run_seed(campaign, seed)
    return replace(result, trace=(), dropped=0)


def run_campaign(
    campaign: Campaign, seeds: Sequence[int], jobs: int, on_result: Callable[[ScenarioResult], None] | None = None
) -> list[ScenarioResult]:
    """Return a result for each seed, in their order; `jobs` at a time."""
    campaign.check()
    return each(jobs, partial(_slim, campaign), seeds, on_result)


def verdict_of(campaign: Campaign, results: Sequence[ScenarioResult], chosen: Sequence[str]) -> ScenarioResult:
    """Return the result of the campaign: how many seeds checked each rule, and how often faults took effect.

    It is FAILED if a seed is. It is INCONCLUSIVE if a seed is, if no seed checked a rule of the scenario, or if no
    fault took effect. `chosen`: the command-line options that choose these seeds.
    """
    scenario = load_scenario(campaign.path, campaign.profiles)
    checks = [*_seeds_check(results), *_rule_checks(results)]
    if campaign.random_faults is not None:
        checks.append(_faults_check(results))
    verdicts = [check.verdict for check in checks]
    worst = next((v for v in (Verdict.FAILED, Verdict.INCONCLUSIVE) if v in verdicts), Verdict.PASSED)
    first = next((check for check in checks if check.verdict is worst), None)
    told = f"{first.number}: {first.text}: {first.got}" if first is not None and worst is not Verdict.PASSED else ""
    made = result_of(scenario, "virtual", worst, checks=tuple(checks), reason=told)
    return replace(
        made,
        name=f"{made.name} [{len(results)} seeds]",
        reproduce=reproduce(scenario, *campaign.words, *chosen),
        simulated_s=sum(result.simulated_s for result in results),
        took_s=sum(result.took_s for result in results),
    )


def _seeds_check(results: Sequence[ScenarioResult]) -> list[CheckResult]:
    """Return the check that every seed passed."""
    bad = [result for result in results if result.verdict is not Verdict.PASSED]
    failed = [result for result in bad if result.verdict.bad]
    verdict = Verdict.FAILED if failed else Verdict.INCONCLUSIVE if bad else Verdict.PASSED
    named = ", ".join(f"{one.seed} ({one.verdict.value})" for one in bad[:10]) + (", ..." if len(bad) > 10 else "")
    got = f"{len(results) - len(bad)} of {len(results)} passed" + (f"; not: {named}" if bad else "")
    return [CheckResult("seeds", "every seed passes", verdict, expected="all of them" if bad else "", got=got)]


def _rule_checks(results: Sequence[ScenarioResult]) -> list[CheckResult]:
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
        puts_in = number.startswith(("fault ", "set "))  # listed only if it had no effect
        judged = len(results) - len(every) if puts_in else sum(not one.vacuous for one in every)
        verdict = Verdict.FAILED if broken else Verdict.PASSED
        if not judged and "invariant" not in number:
            verdict = Verdict.INCONCLUSIVE
        got = f"checked with {judged} of {len(results)} seeds, broken with {broken}"
        checks.append(CheckResult(number, first.text, verdict, got=got, where=first.where, names=first.names))
    return checks


def _faults_check(results: Sequence[ScenarioResult]) -> CheckResult:
    """Return the check that at least one fault took effect, with the number of times by name of the fault."""
    names = sorted({fault.name for result in results for fault in result.faults})
    struck = {n: [fault.struck for result in results for fault in result.faults if fault.name == n] for n in names}
    parts = [f"{name} {len(each)} (took effect {sum(each)} times)" for name, each in struck.items()]
    got = f"{sum(map(len, struck.values()))} injected: {', '.join(parts)}" if parts else "none was injected"
    verdict = Verdict.PASSED if any(map(sum, struck.values())) else Verdict.INCONCLUSIVE
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
