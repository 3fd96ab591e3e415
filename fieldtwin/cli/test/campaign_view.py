"""`fieldtwin test --seeds`: a campaign on a terminal, and its results for reports."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from rich.markup import escape

from fieldtwin.__about__ import __version__
from fieldtwin.cli.campaign_options import CampaignOptions
from fieldtwin.cli.campaigns.causes import SEARCH_INTERRUPTED, FoundCause, find_causes, shrunk_texts
from fieldtwin.cli.campaigns.ending import different_texts, ends_early, interrupted_text, repeats_text
from fieldtwin.cli.campaigns.failures import examine_failures
from fieldtwin.cli.output_files import write_text
from fieldtwin.cli.run.campaign_progress import CampaignView
from fieldtwin.cli.run.virtual_view import coverage_text
from fieldtwin.console import stdout
from fieldtwin.gateway.wallclock import WallClock
from fieldtwin.reports.campaign.model import CampaignResult
from fieldtwin.results.model import CheckResult, ScenarioResult, Verdict
from fieldtwin.run.campaigns.campaign import Campaign, ScenarioRuns, broken_by, scenario_entry, verdict_of, what_tests
from fieldtwin.run.campaigns.causes import Cause, shape_text
from fieldtwin.run.campaigns.confirming import CONFIRMED
from fieldtwin.run.campaigns.coverage import Coverage
from fieldtwin.run.campaigns.ledger import FirstPlaces, Ledger, LedgerEntry
from fieldtwin.run.campaigns.merging import Runs
from fieldtwin.run.campaigns.reporting import campaign_of
from fieldtwin.run.campaigns.reruns import Shrunk
from fieldtwin.run.campaigns.shrink_failure import confirm, scenario_of
from fieldtwin.run.places.place import Ended, Place, Repeats, run_units
from fieldtwin.run.places.sample import sample_of
from fieldtwin.scenarios.language.file_name import SUFFIX, case_of

_COLOUR = {"passed": "green", "failed": "red", "error": "red", "inconclusive": "yellow", "skipped": "yellow"}
FAULTS_SHOWN = 12
INTERRUPTED_CHECK = "interrupted"
"""The number of the check of a campaign that Ctrl-C has ended early."""


@dataclass(frozen=True, slots=True)
class CampaignResults:
    """The results of the whole campaign, of each seed that ran, and of the scenario that the first failing seed was shrunk to.

    `interrupted`: Ctrl-C ended the campaign early. `report`: the campaign for its HTML report, without waivers.
    """

    whole: ScenarioResult
    seeds: list[ScenarioResult]
    shrunk: list[ScenarioResult]
    interrupted: bool
    report: CampaignResult

    @property
    def all(self) -> list[ScenarioResult]:
        return [self.whole, *self.seeds, *self.shrunk]


def run_scenario_campaign(
    path: Path,
    profiles: tuple[Path, ...],
    options: CampaignOptions,
    place: Place,
    show: Callable[[ScenarioResult], None] | None,
    *,
    measures: bool,
) -> CampaignResults:
    """Run a scenario with each seed that the ledger does not have yet. `show` None: nothing is printed to stdout. `measures`: the
    runs measure the coverage of Structured Text.
    """
    seeds = options.chosen()
    campaign = Campaign(path, profiles, options.of(options.faults), options.duration_s, _words(options))
    work, what = ScenarioRuns(campaign, measures), what_tests(campaign)
    ledger = Ledger(options.ledger) if options.ledger is not None else None
    before = ledger.recorded(what, seeds) if ledger is not None else []
    done = {entry.seed for entry in before}
    left = [seed for seed in seeds if seed not in done]
    campaign.check()
    repeats = Repeats(work, sample_of(left))
    results: list[ScenarioResult] = []
    entries: list[LedgerEntry] = []
    places = FirstPlaces(before)

    def record(one: Ended[int, ScenarioResult]) -> None:
        entries.append(places.once(scenario_entry(what, one, WallClock().utc_ns() / 1e9)))
        if ledger is not None:
            ledger.record(entries[-1])

    with CampaignView(case_of(path), len(left)) as view:

        def ended(one: Ended[int, ScenarioResult]) -> None:
            results.append(
                replace(one.result, programs=None)
            )  # first, because Ctrl-C may come while the entry is written
            record(one)
            passed = one.result.verdict is Verdict.PASSED
            cause = None if passed else one.result.why or one.result.verdict.value
            view.ended(one.unit, one.result.simulated_s / 3600, cause, one.result.coverage)

        interrupted = ends_early(lambda: run_units(place, work, left, ended, repeats))
    results.sort(key=lambda result: result.seed or 0)
    different = {first.unit for first, _ in repeats.different}
    for _, second in repeats.different:
        record(second)
    if ledger is not None:
        different |= ledger.different_of(what, seeds)
    shard = ("--shard", options.shard) if options.shard else ()
    more = [*_repeats_checks(different, repeats), *([_interrupted(len(results), len(left))] if interrupted else [])]
    whole = verdict_of(campaign, results, ("--seeds", options.seeds, *shard), before, more)
    if show is not None:
        for result in results:
            _show_seed(result, show)
    failed = [result for result in results if result.verdict.bad and result.trace_hash]
    has_faults = campaign.random_faults is not None
    examined = examine_failures(
        place,
        work,
        {result.seed or 0: result.trace_hash for result in failed},
        case_of(path),
        (lambda: _causes(place, work, failed, len(results))) if has_faults else None,
        interrupted=interrupted,
    )
    if show is not None:
        reproduce = {result.seed or 0: result.reproduce for result in failed}
        examined.show(list(reproduce), reproduce.__getitem__)
        if examined.search_interrupted:
            stdout.print(SEARCH_INTERRUPTED, soft_wrap=True)
        _show_whole(whole)
    files = examined.traces.plain()
    report = campaign_of(
        Runs(what, __version__, tuple(entries if ledger is None else ledger.entries_of(what, seeds))),
        frozenset(seeds),
        [options.ledger.name] if options.ledger is not None else [],
        whole.reproduce,
        traces=files,
        inconclusive=[
            f"{check.number}: {check.text}: {check.got}"
            for check in whole.checks
            if check.verdict is Verdict.INCONCLUSIVE
        ],
    )
    return CampaignResults(
        whole,
        [replace(one, trace_file=files.get(one.seed or 0, "")) for one in results],
        [one.confirmed for one in examined.causes if one.confirmed is not None],
        examined.interrupted,
        report,
    )


def _repeats_checks(different: Collection[int], repeats: Repeats[int, ScenarioResult]) -> list[CheckResult]:
    """Return the check that seeds which ran again on a different worker had the same trace; none if there is nothing to check."""
    if not repeats.count and not different:
        return []
    verdict = Verdict.FAILED if different else Verdict.PASSED
    got = "; ".join([repeats_text(repeats), *different_texts(different, repeats)])
    return [CheckResult("repeated", "the same seed gives the same run on every worker", verdict, got=got)]


def _interrupted(ended: int, wanted: int) -> CheckResult:
    return CheckResult(INTERRUPTED_CHECK, "every seed runs", Verdict.INCONCLUSIVE, got=interrupted_text(ended, wanted))


def _words(options: CampaignOptions) -> tuple[str, ...]:
    """Return the options that define a seed's run, without the seed, as words of a command line."""
    said = {
        "--faults": options.faults or "",
        "--for": f"{options.duration_s:g}s" if options.duration_s else "",
        "--fault-every": f"{options.fault_every:g}s" if options.fault_every is not None else "",
        "--fault-kinds": ",".join(options.fault_kinds),
        "--fault-aims": ",".join(options.fault_aims),
    }
    return tuple(word for option, value in said.items() if value for word in (option, value))


def _show_seed(result: ScenarioResult, show: Callable[[ScenarioResult], None]) -> None:
    """Print one line for a seed that passed, with the faults that took effect, and the whole result for a seed that failed."""
    if result.verdict is not Verdict.PASSED:
        show(result)
        return
    struck = [
        f"{one.name} on {one.on} ({'once' if one.struck == 1 else f'{one.struck} times'})"
        for one in result.faults
        if one.struck
    ]
    idle = sum(not one.struck for one in result.faults)
    told = [*struck[:FAULTS_SHOWN], *([f"{len(struck) - FAULTS_SHOWN} more"] if len(struck) > FAULTS_SHOWN else [])]
    told += [f"{idle} never took effect"] if idle else []
    text = "; ".join(told) or "no fault"
    stdout.print(
        f"[green]passed[/green]  seed {result.seed}  [dim]{escape(text)}[/dim]", soft_wrap=True, highlight=False
    )


def _show_whole(whole: ScenarioResult) -> None:
    colour = _COLOUR[whole.verdict.value]
    stdout.print(f"[{colour}]{whole.verdict.value}[/{colour}]  {escape(whole.title)}", soft_wrap=True, highlight=False)
    for check in whole.checks:
        text = f"  {check.number}: {check.text}: {check.got}"
        stdout.print(text, soft_wrap=True, markup=False, highlight=False)
    stdout.print(f"  coverage: {coverage_text(Coverage.parse(whole.coverage))}", soft_wrap=True, highlight=False)


def _causes(
    place: Place, work: ScenarioRuns, failed: Sequence[ScenarioResult], seeds: int
) -> tuple[list[FoundCause], bool]:
    """Return the causes of failed runs, each with its scenario, and whether Ctrl-C ended the search early."""
    by_seed = {result.seed or 0: result for result in failed}

    def written(cause: Cause[int, Shrunk[ScenarioResult]]) -> FoundCause:
        scenario, lines, confirmed = _written(work.campaign, cause.small)
        check = next(iter(broken_by(by_seed[cause.runs[0]])), "")
        return FoundCause(check, shape_text(cause.small.faults), tuple(cause.runs), scenario, tuple(lines), confirmed)

    return find_causes(place, work, by_seed, seeds, written)


def _written(campaign: Campaign, small: Shrunk[ScenarioResult]) -> tuple[str, list[str], ScenarioResult | None]:
    """Write the shrunk schedule as a scenario and run it. Return its path, sentences about it, and its result if it is
    confirmed.
    """
    if not small.result.verdict.bad:
        return "", [f"seed {small.seed} does not fail again with the same faults, so no scenario is written"], None
    path = Path(f"{case_of(campaign.path)}-seed{small.seed}{SUFFIX}")
    write_text(path, scenario_of(campaign, small, Path()))
    confirmed = confirm(path, campaign, small)
    lines = shrunk_texts(
        small.seed, len(small.faults), small.minimal, small.without.verdict is Verdict.PASSED, [small.without.reason]
    )
    lines.append(f"it is written to {path}")
    lines.append(
        CONFIRMED if confirmed else f"not confirmed: this scenario has a different result; use {small.result.reproduce}"
    )
    return str(path), lines, confirmed
