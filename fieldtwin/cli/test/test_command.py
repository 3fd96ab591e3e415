"""`fieldtwin test`: run scenarios and report the results as a table, JSON, JUnit XML or HTML."""

from __future__ import annotations

import json
import shlex
import shutil
import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

import click
from click.core import ParameterSource
from rich.markup import escape
from rich.table import Table

from fieldtwin.__about__ import __version__
from fieldtwin.cli.campaign_options import CampaignOptions
from fieldtwin.cli.campaigns.ending import INTERRUPTED
from fieldtwin.cli.campaigns.st_coverage import (
    CoverageOptions,
    coverage_of,
    recorded,
    show_campaign_coverage,
    show_coverage,
    write_measured,
)
from fieldtwin.cli.junit_options import JunitOptions
from fieldtwin.cli.option_groups import GroupedCommand, group
from fieldtwin.cli.options import json_option
from fieldtwin.cli.plc.finding_options import TARGET as CHECK_OF_PROGRAMS
from fieldtwin.cli.plc.finding_options import FindingOptions
from fieldtwin.cli.template_question import TemplateSearchOptions
from fieldtwin.cli.test.plain_result import plain_result
from fieldtwin.cli.test.target_options import TargetOptions
from fieldtwin.cli.test.trace_files import trace_files
from fieldtwin.cli.test.unit_tests import UnitTestOptions, is_unit_test, load_suites, run_suites, unit_tests_below
from fieldtwin.conformance.core.case import Impact
from fieldtwin.console import show_warnings, stderr, stdout
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.plc.source_files import TEST_SUFFIX
from fieldtwin.scenarios.language.file_name import SUFFIX

if TYPE_CHECKING:
    from fieldtwin.reports.campaign.model import CampaignResult
    from fieldtwin.results.model import Machine, ScenarioResult, SystemKey
    from fieldtwin.twin.site.system import System

_CONTROLLER = "fieldtwin.controller"
_COLOUR = {"passed": "green", "failed": "red", "error": "red", "inconclusive": "yellow", "skipped": "yellow"}


class _WithCommand(GroupedCommand):
    """A command whose line may end with ``--with -- CMD [ARG]...``: CMD and its arguments go to `controller_words`."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        if "--with" in args and "--" in args[args.index("--with") :]:
            at = args.index("--", args.index("--with"))
            ctx.meta[_CONTROLLER] = tuple(args[at + 1 :])
            args = args[:at]
        return super().parse_args(ctx, args)


@click.command("test", cls=_WithCommand)
@click.argument("files", nargs=-1, type=click.Path(exists=True))
@group("Target", at=TargetOptions)
@group(
    "Runs",
    click.option("--seed", type=int, default=None, help="Use this seed instead of the scenario's."),
    click.option(
        "--retry-inconclusive",
        "retries",
        type=click.IntRange(0, 100),
        default=0,
        metavar="N",
        help="Not in virtual time: repeat an inconclusive scenario at most N times.",
    ),
    click.option(
        "--waivers",
        type=click.Path(exists=True, dir_okay=False),
        help="YAML file of accepted failures: id, owner, reason, expires.",
    ),
)
@group("Campaign of seeds, in virtual time", campaign=CampaignOptions)
@group("Unit tests in Structured Text", units=UnitTestOptions)
@group("Findings about programs", about=FindingOptions)
@group("Profiles and templates", sources=TemplateSearchOptions)
@group("Output", junit=JunitOptions)
@group("Output", logic=CoverageOptions)
@group(
    "Output",
    click.option(
        "--html", type=click.Path(dir_okay=False), help="Write an HTML page with verdicts and diagrams to this file."
    ),
    click.option(
        "--trace",
        type=click.Path(dir_okay=False),
        help="Write every event of a single scenario to this file (JSON lines).",
    ),
    click.option(
        "--traces",
        type=click.Path(file_okay=False, path_type=Path),
        help="Write every event of each scenario to a file in this folder, which fieldtwin studio shows.",
    ),
    click.option(
        "--variable",
        "variables",
        multiple=True,
        metavar="NAME",
        help="Write this variable of a program into the traces after each scan that changes it, such as main.timer.ET. "
        "Can be repeated.",
    ),
    click.option(
        "--progress",
        type=click.Path(dir_okay=False),
        help="Write the steps, verdicts and checked values of a single scenario to this file while it runs (JSON lines).",
    ),
    json_option,
)
def command(
    files: tuple[str, ...],
    at: TargetOptions,
    seed: int | None,
    retries: int,
    waivers: str | None,
    campaign: CampaignOptions,
    units: UnitTestOptions,
    about: FindingOptions,
    sources: TemplateSearchOptions,
    junit: JunitOptions,
    logic: CoverageOptions,
    html: str | None,
    trace: str | None,
    traces: Path | None,
    variables: tuple[str, ...],
    progress: str | None,
    as_json: bool,
) -> int:
    """Run the scenarios and unit tests in FILES (for a folder, all in it; default: those of the working directory).

    Scenarios are files *.scenario.yaml. Unit tests are TEST blocks in Structured Text, in files *.test.st or in the file of a
    program, and with --dialect codesys or twincat suites of TcUnit; they run without a system. The exit code is 0 if all
    passed, and 1 otherwise: a scenario that was skipped or is inconclusive has not passed.

    \b
    --target local    gateway, PLC and emulators as processes, on ptys and
                      sockets of this host
    --target compose  a running system, tested from inside its network:
                      docker compose exec controller fieldtwin test ...
    --target real     the plant: no faults, no set values, read-only without
                      --allow write
    --with -- CMD     your control program against the simulated devices,
                      restarted for each scenario
    --seeds 1..200 --faults random
                      a campaign: rules that must always hold are checked under
                      random faults
    """
    from fieldtwin.conformance.core.waivers import Waivers, load_waivers
    from fieldtwin.results.model import Report, key_of
    from fieldtwin.run.targets.progress import Progress
    from fieldtwin.run.targets.scenario_targets import ScenarioTarget, run_scenario
    from fieldtwin.run.targets.template_scenarios import agree_to_scenario
    from fieldtwin.scenarios.judging.waiving import all_well, ids_of, waive
    from fieldtwin.scenarios.language.form import load_scenario

    target, controller = _controller(at.target, at.with_command)
    paths, unit_tests = _found(files, units.dialect, with_unit_tests=target == "virtual" and not campaign.seeds)
    for option, given in (("--trace", trace), ("--progress", progress)):
        if given and len(paths) != 1:
            raise UsageError(f"{option} needs a single scenario", got=f"{len(paths)} of them")
    _check(target, at)
    if variables and (target != "virtual" or campaign.seeds or not (trace or traces)):
        raise UsageError(
            "--variable needs a trace of a run in virtual time", expected="--trace FILE or --traces FOLDER"
        )
    if retries and target == "real" and Impact(at.allow).rank > Impact.READ.rank:
        raise UsageError(
            "--retry-inconclusive would repeat a scenario's writes to a plant",
            expected="--allow read, or no retries",
        )
    _check_campaign(campaign, target, (seed, trace, traces, progress, retries))
    events = trace_files(paths, trace, traces)
    folders = sources.profiles
    for path in paths:
        agree_to_scenario(sources.ask(), path, folders, plant=target == "real", virtual=target == "virtual")
    scenarios = [load_scenario(path, folders) for path in paths]
    suites = load_suites(unit_tests, units)
    show_warnings(dict.fromkeys(warning for one in scenarios for warning in one.system.warnings))
    findings = about.check(one.system for one in scenarios)
    known = [id for one in scenarios for id in ids_of(one.path, one.form.scenario)]
    known += [one.name for one in findings]
    known += [test.name for suite in suites for test in suite.tests]
    waived = load_waivers(Path(waivers), known) if waivers else Waivers()
    where = ScenarioTarget(
        target,
        seed,
        at.instance,
        at.field_host,
        at.token,
        at.far,
        at.capture,
        Impact(at.allow),
        at.can,
        controller,
        variables,
    )
    measures = logic.wanted(html=html is not None)
    recording = logic.recording(target, html=html is not None) if not campaign.seeds else None
    shown = Progress(Path(progress)) if progress else None
    results = [waive(one, waived, datetime.now(UTC).date()) for one in findings]
    for one in () if as_json else results:
        _show(one)
    seeds: list[ScenarioResult] = []
    campaigns: list[CampaignResult] = []
    interrupted = False
    with campaign.place() as place:
        for scenario, file in zip(scenarios, events, strict=True):
            if campaign.seeds:
                from fieldtwin.cli.test.campaign_view import run_scenario_campaign

                show = None if as_json else _show
                found = run_scenario_campaign(scenario.path, folders, campaign, place, show, measures=measures)
                today = datetime.now(UTC).date()
                judged = [waive(replace(one, system=scenario.system), waived, today) for one in found.all]
                results += judged
                campaigns.append(found.report)
                seeds += judged[1 : 1 + len(found.seeds)]
                interrupted = found.interrupted
                if interrupted:
                    break
                continue
            with recorded(recording):
                result = run_scenario(scenario, where, file, retries, shown)
            result = replace(result, system=scenario.system)
            results.append(waive(result, waived, datetime.now(UTC).date()))
            if not as_json:
                _show(results[-1])
    if shown is not None:
        shown.close()
    for unit_test in run_suites(suites, units):
        results.append(waive(unit_test, waived, datetime.now(UTC).date()))
        if not as_json:
            _show(results[-1])
    covered = coverage_of(suites, recording, campaigns)
    if logic.coverage is not None and campaign.seeds:
        write_measured(covered, logic.coverage)
    else:
        logic.write(covered)
    draws = html is not None and not campaign.seeds
    machines = _machines([one.system for one in scenarios]) if draws else {}
    system = scenarios[0].system if scenarios else None
    report = Report(
        "scenarios" if scenarios else "unit tests",
        results,
        system,
        target if scenarios else "",
        seed,
        reproduce=shlex.join(["fieldtwin", *sys.argv[1:]]),
        versions={"fieldtwin": __version__},
        machines=machines[key_of(system)] if draws and system is not None else (),
        machines_of=machines,
        served=(),
        logic=covered,
    )
    if junit.junit is not None:
        from fieldtwin.reports.junit import Flavour, write_junit

        write_junit(report, junit.junit, Flavour(junit.junit_flavour))
    if html:
        from fieldtwin.reports.campaign.html import write_campaign
        from fieldtwin.reports.run.html import write_html
        from fieldtwin.results.trace_about import note_report

        if campaign.seeds:
            write_campaign(campaigns, Path(html), results[: len(findings)])
        else:
            write_html(report, Path(html))
        for result in results:
            if result.trace_file:
                note_report(Path(result.trace_file), Path(html))
    if as_json:
        json.dump([plain_result(result) for result in results], sys.stdout, indent=2)
        sys.stdout.write("\n")
    else:
        if campaign.seeds:
            show_campaign_coverage(covered, [(one.measured, len(one.runs)) for one in campaigns])
        elif covered is not None:
            show_coverage(covered)
        stdout.print(f"[bold]{_counts(seeds or results, 'seeds: ' if seeds else '')}[/bold]")
        if not campaign.seeds:
            _tell_how_to_see_more(results)
    return INTERRUPTED if interrupted else 0 if all_well(results) else 1


def _counts(results: Sequence[ScenarioResult], of: str) -> str:
    """Return the last line of the output, such as ``3 passed, 1 failed``; `of` is the text before the numbers."""
    counts = Counter(result.verdict.value for result in results)
    return of + ", ".join(f"{n} {verdict}" for verdict, n in counts.items())


def _check_campaign(campaign: CampaignOptions, target: str, of_one_run: tuple[object, ...]) -> None:
    """Raise `UsageError` if a campaign cannot be combined with the other options."""
    campaign.check()
    if campaign.seeds and target != "virtual":
        raise UsageError(
            "--seeds needs virtual time: otherwise a seed does not reproduce a run",
            expected="--target virtual, without --with",
            got=f"--target {target}",
        )
    if campaign.seeds and any(of_one_run):
        raise UsageError(
            "--seeds, which makes several runs",
            hint="--seed, --trace, --traces, --progress and --retry-inconclusive need a single run",
        )


def _controller(target: str, with_command: bool) -> tuple[str, tuple[str, ...]]:
    """Return the target, and the user's program with its arguments. Raises `UsageError` if they do not fit together."""
    ctx = click.get_current_context()
    words: tuple[str, ...] = ctx.meta.get(_CONTROLLER, ())
    if not with_command:
        return target, ()
    if not words:
        raise UsageError("--with needs a command", expected="fieldtwin test FILE.scenario.yaml --with -- CMD [ARG]...")
    if ctx.get_parameter_source("target") is ParameterSource.DEFAULT:
        target = "local"
    if target == "virtual":
        raise UsageError(
            "--with cannot run in virtual time: your program uses the clock of this host",
            expected="--target local, which is the default with --with",
        )
    if target != "local":
        raise UsageError(
            f"--with starts the simulated devices and your program itself, and --target {target} tests a running system",
            expected="--target local, which is the default with --with",
        )
    if shutil.which(words[0]) is None:
        raise UsageError(
            f"cannot start {words[0]!r}: no such program", hint="check that it is on the PATH and executable"
        )
    return target, words


def _check(target: str, at: TargetOptions) -> None:
    if at.can and target != "local":
        raise UsageError("--can needs --target local", got=f"--target {target}")
    if target != "real" and (at.far or at.allow != Impact.READ.value):
        raise UsageError("--far and --allow need --target real", got=f"--target {target}")
    if target in ("virtual", "local") and at.instance:
        raise UsageError("--instance names a running instance", expected="--target compose or real")
    if at.capture and target != "compose" and not at.instance:
        raise UsageError(
            "--capture needs a running instance", expected="--target compose, or --target real --instance NAME"
        )


def _found(files: tuple[str, ...], dialect: str, *, with_unit_tests: bool) -> tuple[list[Path], list[Path]]:
    """Return the scenarios and the files of unit tests that the user named, and those in the folders that the user named."""
    scenarios: list[Path] = []
    unit_tests: list[Path] = []
    for name in files or (".",):
        path = Path(name)
        if path.is_dir():
            scenarios += sorted(path.rglob(f"*{SUFFIX}"))
            unit_tests += unit_tests_below(path, dialect) if with_unit_tests else []
        elif not is_unit_test(path):
            scenarios.append(path)
        elif with_unit_tests:
            unit_tests.append(path)
        else:
            raise UsageError(
                "a unit test runs without a system, in its own virtual time", expected="no --target, --with and --seeds",
                got=name,
            )  # fmt: skip
    if not scenarios and not unit_tests:
        expected = f"files that end in {SUFFIX} or {TEST_SUFFIX}, or TEST blocks"
        raise UsageError("no scenarios and no unit tests", expected=expected)
    return scenarios, unit_tests


def _show(result: object) -> None:
    from fieldtwin.results.model import ScenarioResult, Verdict

    assert isinstance(result, ScenarioResult)
    colour = _COLOUR[result.verdict.value]
    took = f"[dim]{round(result.simulated_s, 3):g} s in {result.took_s:.1f} s[/dim]"
    stdout.print(f"[{colour}]{result.verdict.value}[/{colour}]  {escape(result.title)}  {took}", soft_wrap=True)
    for n, reason in enumerate(result.earlier, 1):
        stdout.print(f"  attempt {n} of {result.attempts} was inconclusive: {escape(reason)}", soft_wrap=True)
    for check in result.checks:
        if check.reason and check.verdict is Verdict.PASSED:
            stdout.print(f"  {check.number}: {escape(check.reason)}", soft_wrap=True)
        if check.verdict is Verdict.SKIPPED and result.verdict is Verdict.PASSED:
            stdout.print(f"  {check.number} skipped: {escape(check.got or check.reason)}", soft_wrap=True)
    for fault in result.faults:
        stdout.print(f"  fault {escape(fault.text)}", soft_wrap=True, highlight=False)
    if result.verdict is Verdict.PASSED:
        return
    if result.reason:
        stdout.print(f"  {escape(result.reason)}", soft_wrap=True)
    table = Table(box=None, show_header=False, pad_edge=False)
    for check in result.checks:
        if check.verdict is not Verdict.PASSED:
            if check.number not in result.reason.partition(":")[0].split():  # not repeated from the headline
                waived = f" ({check.reason})" if result.target == CHECK_OF_PROGRAMS and check.reason else ""
                table.add_row(f"  {check.number}", escape(check.text + waived))
            if check.expected:
                table.add_row("  expected", escape(check.expected))
            if result.target == CHECK_OF_PROGRAMS:
                continue
            table.add_row("  got", escape(check.got))
            table.add_row("  at", f"{(check.t_ns or 0) / 1e9:.3f} s, {escape(check.where)}")
    if table.row_count:
        stdout.print(table)
    for n, line in enumerate(result.evidence):
        stdout.print(f"  {'  ' if n else ''}{escape(line)}", soft_wrap=True, highlight=False)
    stdout.print(f"  {escape(result.reproduce)}", soft_wrap=True)


def _tell_how_to_see_more(results: Sequence[ScenarioResult]) -> None:
    """Name the command that shows every event of the first scenario that failed."""
    from fieldtwin.results.model import Verdict

    failed = next((result for result in results if result.verdict is Verdict.FAILED and result.reproduce), None)
    if failed is None:
        return
    if failed.trace_file:
        text = f"all events: fieldtwin studio {shlex.quote(failed.trace_file)}"
    elif failed.target == "virtual":
        text = f"all events: {failed.reproduce} --trace fail.jsonl; fieldtwin studio fail.jsonl"
    else:
        return  # a second run in real time has different events
    stderr.print(text, soft_wrap=True, markup=False, highlight=False)


def _machines(systems: list[System]) -> dict[SystemKey, tuple[Machine, ...]]:
    """Return the state machines of each system's programs. Equal systems are evaluated once."""
    from fieldtwin.reports.run.machines import machines_of
    from fieldtwin.results.model import key_of

    return {key: machines_of(system) for key, system in {key_of(system): system for system in systems}.items()}
