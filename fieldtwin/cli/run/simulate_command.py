"""`fieldtwin simulate`: run prototypes in virtual time, with seeds, ledgers, random faults and comparisons of traces."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import click

from fieldtwin.cli.campaign_options import FaultChoice, SeedOptions
from fieldtwin.cli.campaign_reports import CampaignReports
from fieldtwin.cli.completions import systems
from fieldtwin.cli.option_groups import GroupedCommand, group
from fieldtwin.cli.options import Duration, json_option
from fieldtwin.cli.run.run_options import ReplayOptions, commands_option, systems_of
from fieldtwin.cli.run.virtual_view import run_many, run_one
from fieldtwin.cli.template_question import TemplateSearchOptions
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.run.template import system_file

if TYPE_CHECKING:
    from fieldtwin.run.virtual.run import VirtualOptions

OF_A_GROUP = (
    "--for, --seed, --seeds, --shard, --jobs, --on, --ledger, --junit, --html, --coverage, --commands, --faults, --trace, "
    "--json"
)


@click.command("simulate", cls=GroupedCommand)
@click.argument("system", shell_complete=systems)
@group(
    "Virtual time and seeds",
    click.option(
        "--for", "duration_s", type=Duration(), default=0.0, help="Length in virtual time, such as 24h; required."
    ),
    click.option("--seed", type=int, default=None, help="Use this seed instead of the prototype file's."),
    runs=SeedOptions,
)
@group("Simulated devices", replay=ReplayOptions)
@group("Simulated devices", commands_option)
@group(
    "Faults",
    click.option(
        "--faults",
        default="",
        metavar="FILE|random|guided",
        help="Inject the faults of this file (see fieldtwin faults); random: the seed chooses them; guided: also their effects "
        "and the states of the programs.",
    ),
    choice=FaultChoice,
)
@group("Profiles and templates", sources=TemplateSearchOptions)
@group(
    "Output",
    click.option(
        "--trace",
        type=click.Path(dir_okay=False, path_type=Path),
        help="Write every event to this file (JSON lines).",
    ),
    click.option(
        "--variable",
        "variables",
        multiple=True,
        metavar="NAME",
        help="Write this variable of a program into the trace after each scan that changes it, such as main.timer.ET; "
        "named as in fieldtwin plc trace. Can be repeated.",
    ),
    click.option(
        "--compare",
        type=click.Path(exists=True, dir_okay=False, path_type=Path),
        help="Compare the run with an older trace, as fieldtwin trace --against; exit code 1 if it differs.",
    ),
    json_option,
)
@group("Output", reports=CampaignReports)
def command(
    system: str,
    duration_s: float,
    seed: int | None,
    runs: SeedOptions,
    commands: tuple[int, ...] | None,
    replay: ReplayOptions,
    faults: str,
    choice: FaultChoice,
    sources: TemplateSearchOptions,
    trace: Path | None,
    variables: tuple[str, ...],
    compare: Path | None,
    reports: CampaignReports,
    as_json: bool,
) -> int:
    """Simulate SYSTEM in virtual time, as fast as possible: its prototype, with gateway and PLC, in one process.

    SYSTEM is a file, the name of a shipped system such as `observatory`, a template (see fieldtwin template), or a network of
    several systems, such as `ocean_network`. The same seed gives the same run, byte for byte. No endpoint is opened.

    \b
    fieldtwin simulate observatory --for 24h --seed 7
    fieldtwin simulate observatory --for 2h --faults random \\
        --seeds 1..50 --jobs 2 --ledger hours.jsonl --html hours.html

    Exit code 0 if the run, or each of the runs, passed; else 1.
    """
    if duration_s <= 0:
        raise UsageError("simulate needs an end time", expected="--for 24h")
    if variables and trace is None:
        raise UsageError("--variable without a file for its values", expected="--trace FILE")
    random_faults = choice.of(faults)
    systems = systems_of(system, sources, {**replay.given(), "--compare": compare}, OF_A_GROUP, virtual=True)
    if systems is None:
        system = system_file(
            system, sources.ask(), virtual=True, prototype_file=replay.prototype_file, profiles=sources.profiles
        )
    from fieldtwin.run.virtual.run import VirtualOptions

    options = VirtualOptions(
        system=system if systems is None else str(systems.path),
        duration_s=duration_s,
        seed=seed,
        profiles=sources.profiles,
        prototype_file=replay.prototype_file,
        recordings=replay.recordings,
        speed=replay.speed,
        commands=commands,
        fault_file=Path(faults) if faults and random_faults is None else None,
        random_faults=random_faults,
        trace=trace,
        variables=variables,
    )
    if runs.seeds:
        if trace or compare or seed is not None:
            raise UsageError(
                "--seeds, which makes several runs", hint="--seed, --trace and --compare need a single run"
            )
        with runs.place() as place:
            return run_many(options, runs.chosen(), place, as_json, runs.ledger, reports)
    if given := runs.given or reports.given:
        raise UsageError(f"{given} needs --seeds", expected="--seeds 1..200")
    return run_one(options, as_json) if compare is None else _run_against(options, compare, as_json)


def _run_against(options: VirtualOptions, old: Path, as_json: bool) -> int:
    """Run, then compare the run with the trace in the file `old`; return the worse of the two exit codes."""
    from fieldtwin.cli.recordings.regression_view import judged, show
    from fieldtwin.scenarios.regression.comparing import Allowed
    from fieldtwin.twin.site.system import load_system

    if as_json:
        raise UsageError(
            "--compare with --json", hint="--trace NEW, then fieldtwin trace NEW SYSTEM --against OLD --json"
        )
    with TemporaryDirectory(prefix="ft-") as folder:
        trace = options.trace or Path(folder) / "trace.jsonl"
        code = run_one(replace(options, trace=trace), as_json)
        return max(
            code, show(judged(load_system(options.system, options.profiles), old, trace, Allowed()), old, as_json=False)
        )
