"""`fieldtwin simulate` on a terminal: progress, results, and the failed seeds."""

from __future__ import annotations

import json
import shlex
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.progress import BarColumn, Progress, TextColumn
from rich.table import Table

from fieldtwin.__about__ import __version__
from fieldtwin.cli.campaign_reports import CampaignReports
from fieldtwin.cli.campaigns.causes import SEARCH_INTERRUPTED, simulated_causes
from fieldtwin.cli.campaigns.ending import INTERRUPTED, different_texts, ends_early, interrupted_text, repeats_text
from fieldtwin.cli.campaigns.failures import examine_failures
from fieldtwin.cli.campaigns.st_coverage import show_campaign_coverage
from fieldtwin.cli.run.campaign_progress import CampaignView
from fieldtwin.cli.run.summary_view import print_summary
from fieldtwin.console import show_warnings, stderr, stdout
from fieldtwin.gateway.wallclock import WallClock

if TYPE_CHECKING:
    from fieldtwin.reports.campaign.model import CampaignResult
    from fieldtwin.run.campaigns.coverage import Coverage
    from fieldtwin.run.campaigns.failure_traces import KeptTraces
    from fieldtwin.run.campaigns.ledger import LedgerEntry
    from fieldtwin.run.campaigns.many_seeds import SeedResult
    from fieldtwin.run.places.place import Ended, Place
    from fieldtwin.run.virtual.run import VirtualOptions


OF_MANY_RUNS = (
    "--seeds",
    "--shard",
    "--jobs",
    "--on",
    "--ledger",
    "--junit",
    "--junit-flavour",
    "--html",
    "--coverage",
)
"""Options that the command line of a single run does not have."""


def run_one(options: VirtualOptions, as_json: bool) -> int:
    """Run once and print the summary on stdout. Return the exit status: 0 if the run passed."""
    from fieldtwin.run.virtual.group_kinds import kind_named
    from fieldtwin.run.virtual.run import VirtualRun
    from fieldtwin.twin.plant.physical import program_warnings

    run = VirtualRun(options)
    kind = kind_named(run.group.kind) if run.group.kind else None
    if kind is not None:
        kind.introduce(run.group)
    else:
        show_warnings((*run.group.whole.warnings, *program_warnings(run.group.whole)))
    stderr.print(
        f"{run.group.name} (prototype, virtual time), seed {run.seed}, {shown_time(options.duration_s)}", markup=False
    )
    began_ns = WallClock().monotonic_ns()
    with progress_bar(options.duration_s) as at:
        run.run(at)
    took_s = (WallClock().monotonic_ns() - began_ns) / 1e9
    summary = run.summary()
    if as_json:
        json.dump(summary, sys.stdout, indent=2)
        sys.stdout.write("\n")
    else:
        show = kind.print_summary if kind is not None else print_summary
        show(summary)
        trace = summary["trace"]
        stdout.print(f"  trace          {trace['events']} events, sha256 {trace['sha256']}", soft_wrap=True)
        stdout.print(f"  took           {took_s:.1f} s, {run.elapsed_s / took_s:,.0f} times real time", soft_wrap=True)
    return 0 if summary["ok"] else 1


def again(seed: int) -> str:
    """Return the command line that repeats the run of one seed."""
    words, skip = [], False
    for word in sys.argv[1:]:
        if skip:
            skip = False
        elif word in OF_MANY_RUNS:
            skip = True
        elif not word.startswith(tuple(f"{option}=" for option in OF_MANY_RUNS)):
            words.append(word)
    return shlex.join(["fieldtwin", *words, "--seed", str(seed)])


def run_many(
    options: VirtualOptions,
    seeds: range,
    place: Place,
    as_json: bool,
    ledger_path: Path | None,
    reports: CampaignReports,
) -> int:
    """Run once for each seed and return the exit status: 0 if all passed, 130 if Ctrl-C ended the campaign early.

    `ledger_path`: a file that records each run when it ends. Seeds that it already contains are not repeated, and count
    with their recorded result, also in `reports`.
    """
    from fieldtwin.plc.st.coverage.compact import CompactCoverage
    from fieldtwin.run.campaigns.coverage import joined
    from fieldtwin.run.campaigns.ledger import FirstPlaces, Ledger, entry_of
    from fieldtwin.run.campaigns.many_seeds import SeedRuns, what_runs
    from fieldtwin.run.places.place import Repeats, run_units
    from fieldtwin.run.places.sample import sample_of

    began_ns = WallClock().monotonic_ns()
    ledger = Ledger(ledger_path) if ledger_path is not None else None
    what, system = what_runs(options), Path(options.system).stem
    done = ledger.done(what) if ledger is not None else set()
    left = [seed for seed in seeds if seed not in done]
    hours = options.duration_s / 3600
    entries: list[LedgerEntry] = []
    results: list[SeedResult] = []
    work = SeedRuns(options, reports.measures)
    places = FirstPlaces(ledger.entries_of(what, seeds) if ledger is not None else ())
    repeats = Repeats(work, sample_of(left))

    def record(one: Ended[int, SeedResult]) -> None:
        entry = places.once(entry_of(what, hours, one.result, system, again(one.unit), one.worker))
        if ledger is not None:
            ledger.record(entry)
        entries.append(entry)

    with CampaignView(system, len(left)) as view:

        def ended(one: Ended[int, SeedResult]) -> None:
            slim = replace(one.result, programs=CompactCoverage())  # the entry has it
            results.append(slim)  # first, because Ctrl-C may come while the entry is written
            record(one)
            cause = None if one.result.ok else "; ".join(one.result.errors[:1]) or "failed"
            view.ended(one.unit, hours, cause, one.result.coverage)

        interrupted = ends_early(lambda: run_units(place, work, left, ended, repeats))
    results.sort(key=lambda result: result.seed)
    for _, second in repeats.different:
        record(second)
    different = {first.unit for first, _ in repeats.different}
    if ledger is not None:
        different |= ledger.different_of(what, seeds)
    took_s = (WallClock().monotonic_ns() - began_ns) / 1e9
    failed = [r for r in results if not r.ok]
    before = sorted(ledger.failed_of(what, seeds) - {r.seed for r in failed}) if ledger is not None else []
    untested = (
        options.random_faults is not None
        and bool(results)
        and not any(struck for r in results for _, _, struck in r.faults)
    )
    has_faults = options.random_faults is not None or options.faults or options.fault_file
    finished = [r for r in failed if r.sha256]
    examined = examine_failures(
        place,
        work,
        {r.seed: r.sha256 for r in finished},
        system,
        (lambda: simulated_causes(place, work, finished, len(left))) if has_faults else None,
        interrupted=interrupted,
    )
    whole: CampaignResult | None = None
    if reports.given:
        recorded = ledger.entries_of(what, seeds) if ledger is not None else entries
        untested_all = untested and len(left) == len(seeds)
        whole = _result(what, recorded, seeds, ledger_path, examined.traces, untested=untested_all)
        reports.write([whole])
    if as_json:
        json.dump(
            {
                "results": [_plain(r) for r in results],
                "failed": sorted([*before, *(r.seed for r in failed)]),
                "groups": [one.plain() for one in examined.causes],
                "traces": examined.traces.plain(),
                "coverage": joined(r.coverage for r in results).counts(),
                "repeated": repeats.count,
                "different": sorted(different),
                "interrupted": examined.interrupted,
            },
            sys.stdout,
            indent=2,
        )
        sys.stdout.write("\n")
        return INTERRUPTED if examined.interrupted else 1 if failed or before or untested or different else 0
    for result in failed:
        stdout.print(f"[red]seed {result.seed}[/red]", soft_wrap=True)
        for error in result.errors:
            stdout.print(f"  {error}", soft_wrap=True, markup=False)
        stdout.print(f"  {again(result.seed)}", soft_wrap=True, markup=False)
    examined.show([r.seed for r in finished], again)
    table = Table(box=None, show_header=False, pad_edge=False)
    table.add_row("seeds", f"{len(results)}, {len(failed)} failed")
    table.add_row("virtual time", shown_time(options.duration_s * len(results)))
    checked, wrong = sum(r.checked for r in results), sum(r.wrong for r in results)
    table.add_row("published", f"{checked} compared with what the devices held, {wrong} wrong")
    table.add_row("faults", faults_text([one for r in results for one in r.faults]))
    table.add_row("coverage", coverage_text(joined(r.coverage for r in results)))
    if repeats.count:
        table.add_row("repeated", repeats_text(repeats))
    table.add_row("took", f"{took_s:.1f} s, {options.duration_s * len(results) / took_s:,.0f} times real time")
    if ledger is not None:
        table.add_row("not repeated", f"{len(seeds) - len(left)} seeds that the ledger has")
        failures = (
            f", {len(ledger.failed)} runs failed, {ledger.wrong} wrong values" if ledger.failed else ", no run failed"
        )
        table.add_row(
            "the ledger", f"{shown_time(ledger.hours * 3600)} of virtual time in {len(ledger.entries)} runs{failures}"
        )
    stdout.print(table)
    if whole is not None:
        show_campaign_coverage(whole.programs, [(whole.measured, len(whole.runs))])
    for seed in before:
        stdout.print(f"[red]seed {seed}[/red] failed before, by the ledger: {again(seed)}", soft_wrap=True)
    for line in different_texts(different, repeats):
        stdout.print(line, soft_wrap=True, markup=False, highlight=False)
    if interrupted:
        stdout.print(interrupted_text(len(results), len(left)), soft_wrap=True)
        return INTERRUPTED
    if examined.search_interrupted:
        stdout.print(SEARCH_INTERRUPTED, soft_wrap=True)
    if untested and not failed and not before and not different:
        stdout.print(
            "no fault took effect in any run, so nothing was tested with faults: try a longer --for", soft_wrap=True
        )
        stdout.print("[bold yellow]inconclusive[/bold yellow]")
        return 1
    bad = bool(failed or before or different)
    stdout.print("[bold red]not ok[/bold red]" if bad else "[bold green]ok[/bold green]")
    return INTERRUPTED if examined.interrupted else 1 if bad else 0


def _result(
    what: str,
    entries: Sequence[LedgerEntry],
    seeds: range,
    ledger_path: Path | None,
    traces: KeptTraces,
    *,
    untested: bool,
) -> CampaignResult:
    """Return the campaign for its reports."""
    from fieldtwin.run.campaigns.merging import Runs
    from fieldtwin.run.campaigns.reporting import campaign_of

    return campaign_of(
        Runs(what, __version__, tuple(entries)),
        frozenset(seeds),
        [ledger_path.name] if ledger_path is not None else [],
        shlex.join(["fieldtwin", *sys.argv[1:]]),
        untested=untested,
        traces=traces.plain(),
    )


def coverage_text(coverage: Coverage) -> str:
    """Return how many different situations the runs have reached, by kind."""
    if not coverage.elements:
        return "none is recorded"
    parts = ", ".join(f"{kind} {count}" for kind, count in coverage.counts().items())
    return f"{len(coverage)} different situations ({parts})"


def faults_text(faults: Sequence[tuple[str, int, int]]) -> str:
    """Return how many faults all runs had, and how often they took effect, by name."""
    if not faults:
        return "none was injected"
    of = {name: [(put_in, struck) for other, put_in, struck in faults if other == name] for name, _, _ in faults}
    parts = [
        f"{name} {sum(n for n, _ in each)} (took effect {sum(m for _, m in each)} times)" for name, each in of.items()
    ]
    return f"{sum(n for _, n, _ in faults)} injected: {', '.join(sorted(parts))}"


def _plain(result: SeedResult) -> dict[str, Any]:
    """Return the result as plain data, without the time and place of the run, so that the same campaign gives the same text, and
    without its coverage, which the whole campaign has.
    """
    return {name: getattr(result, name) for name in result.__slots__ if name not in ("made", "coverage", "programs")}


def shown_time(seconds: float) -> str:
    """Return a duration of virtual time, in seconds, as text."""
    if seconds >= 2 * 3600:
        return f"{seconds / 3600:g} h"
    return f"{seconds / 60:g} min" if seconds >= 120 else f"{seconds:g} s"


class progress_bar:
    """A progress bar on stderr, shown on a terminal only. ``with progress_bar(60.0) as at: at(12.0)``."""

    def __init__(self, total: float, unit: str = "s") -> None:
        columns = (
            TextColumn("{task.percentage:3.0f} %"),
            BarColumn(),
            TextColumn("{task.completed:g} {task.fields[unit]}"),
        )
        self._progress = Progress(*columns, console=stderr, transient=True, disable=not stderr.is_terminal)
        self._task = self._progress.add_task("", total=total, unit=unit)

    def __enter__(self) -> Callable[[float], None]:
        self._progress.start()
        return lambda value: self._progress.update(self._task, completed=value)

    def __exit__(self, *exc: object) -> None:
        self._progress.stop()
