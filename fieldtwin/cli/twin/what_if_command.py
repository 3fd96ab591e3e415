"""``fieldtwin what-if``: simulate the effect of a command, a fault, or a whole plan."""

from __future__ import annotations

import asyncio
import json
from pathlib import Path
from typing import Any

import click
from rich.markup import escape

from fieldtwin.cli.option_groups import GroupedCommand, group
from fieldtwin.cli.options import Duration, json_option
from fieldtwin.cli.template_question import TemplateSearchOptions
from fieldtwin.cli.twin.what_if_view import show
from fieldtwin.console import stderr, stdout
from fieldtwin.gateway.core.errors import FileInvalid, UsageError
from fieldtwin.gateway.core.files.input_file import open_input
from fieldtwin.run.template import system_file
from fieldtwin.run.what_if.state import KnownState


@click.command("what-if", cls=GroupedCommand)
@click.argument("system", required=False)
@group(
    "Present state",
    click.option(
        "--from", "source", default="", help="The present state: a state file, a knowledge store, or instance:NAME."
    ),
    click.option("--origin", default="", help="Origin of the knowledge, if the store has several."),
    click.option("--save-state", type=click.Path(path_type=Path), help="Write the present state to a file, and exit."),
)
@group(
    "Plans",
    click.option(
        "--command",
        "commands",
        multiple=True,
        help="A period that the topside controller commands: PERIOD_S or PERIOD_S@TIME.",
    ),
    click.option("--faults", "fault_file", type=click.Path(path_type=Path), help="Fault file, as for `run --faults`."),
    click.option("--plans", "plan_file", type=click.Path(path_type=Path), help="A file with several plans."),
    click.option("--require", multiple=True, help="An expression that must always hold."),
    click.option("--finally", "finally_", multiple=True, help="An expression that must hold at the end."),
)
@group(
    "Simulation",
    click.option(
        "--horizon", "horizon_s", type=Duration(), default="1h", show_default=True, help="Length of the simulated time."
    ),
    click.option(
        "--settle",
        "settle_s",
        type=Duration(),
        default="5s",
        show_default=True,
        help="Time from which on the requirements are checked.",
    ),
    click.option("--jobs", type=click.IntRange(1, 64), default=2, show_default=True, help="Number of processes."),
    click.option("--seed", type=int, help="Seed; default: the prototype file's."),
    click.option(
        "--prototype-file", type=click.Path(path_type=Path), help="Prototype file; default: next to the system file."
    ),
)
@group("Profiles and templates", sources=TemplateSearchOptions)
@group(
    "Output",
    json_option,
    click.option(
        "--series",
        multiple=True,
        metavar="NAME",
        help="With --json: also the values of this tag or variable over time.",
    ),
)
def command(
    system: str | None,
    source: str,
    origin: str,
    commands: tuple[str, ...],
    fault_file: Path | None,
    require: tuple[str, ...],
    finally_: tuple[str, ...],
    plan_file: Path | None,
    horizon_s: float,
    settle_s: float,
    jobs: int,
    seed: int | None,
    prototype_file: Path | None,
    save_state: Path | None,
    sources: TemplateSearchOptions,
    as_json: bool,
    series: tuple[str, ...],
) -> int:
    """Simulate SYSTEM in virtual time from its present state, and show the effect of a plan.

    The plant is not affected. Exit code: 0 if a plan meets all requirements, 1 if no plan does.
    """
    from fieldtwin.run.what_if.fork import Fork
    from fieldtwin.run.what_if.many import answers
    from fieldtwin.run.what_if.plan import WhatIfPlan, in_words, load_plans
    from fieldtwin.run.what_if.plan import command as parsed
    from fieldtwin.twin.site.system import load_system

    if series and not as_json:
        raise UsageError("--series is printed only as JSON", expected="--json with --series")
    plans: list[WhatIfPlan] = []
    if plan_file is not None:
        named, plans = load_plans(plan_file)
        beside = plan_file.parent / named
        system = system or (str(beside) if beside.exists() else named)
    if system is None:
        raise UsageError("which system?", expected="SYSTEM, or --plans FILE which names it")
    folders = sources.profiles
    system = system_file(system, sources.ask(), virtual=True, prototype_file=prototype_file, profiles=folders)
    loaded = load_system(system, folders)
    state = _state(source, origin, system, folders)
    if save_state is not None:
        try:
            save_state.write_text(state.dump(loaded), encoding="utf-8")
        except OSError as e:
            raise FileInvalid(f"cannot be written: {e.strerror or e}", path=str(save_state)) from e
        values, programs = len(state.values), len(state.programs)
        told = f"{values} value{'s'[: values != 1]} and what {programs} program{'s'[: programs != 1]} hold{'s'[: programs == 1]}"
        stderr.print(f"{told} → {escape(str(save_state))}", soft_wrap=True)
        return 0
    if commands or require or finally_ or fault_file or not plans:
        faults = _faults(fault_file, loaded)
        own = tuple(parsed(c) for c in commands)
        plans.append(WhatIfPlan(in_words(own, faults), own, faults, require, finally_))
    fork = Fork(system, state, horizon_s, folders, prototype_file, seed, settle_s, series)
    stderr.print(
        f"{loaded.name}: {len(plans)} plan{'s'[: len(plans) != 1]}, {_ahead(horizon_s)} ahead, from {escape(state.source)}",
        soft_wrap=True,
    )
    outcomes = answers(
        fork,
        plans,
        jobs,
        lambda o: stderr.print(f"  {escape(o.plan)}: {'met' if o.met else 'not met'}, {o.took_s:.1f} s"),
    )
    if as_json:
        found: dict[str, Any] = {
            "fieldtwin_what_if": 1,
            "system": loaded.name,
            "from": state.source,
            "utc_ms": state.utc_ms,
        }
        click.echo(json.dumps(found | {"outcomes": [o.described() for o in outcomes]}, indent=1))
    else:
        units = {f"{d.name}.{t.name}": t.unit or "" for d in loaded.devices.values() for t in d.profile.tags.values()}
        show(stdout, outcomes, units)
    return 0 if any(o.met for o in outcomes) else 1


def _ahead(seconds: float) -> str:
    """Return a duration as text, in the largest unit of which it contains at least two: ``10 min``, ``90 min``, ``2 h``."""
    for unit, name in ((86_400, "d"), (3600, "h"), (60, "min")):
        if seconds >= 2 * unit:
            return f"{seconds / unit:g} {name}"
    return f"{seconds:g} s"


def _state(source: str, origin: str, system: str, folders: tuple[Path, ...]) -> KnownState:
    from fieldtwin.run.what_if.known import known_state
    from fieldtwin.run.what_if.state import of_instance, read_state
    from fieldtwin.twin.site.system import load_system

    loaded = load_system(system, folders)
    if not source:
        return KnownState()
    if source.startswith("instance:"):
        from fieldtwin.run.processes.plc_client import choose

        return asyncio.run(of_instance(choose(source.removeprefix("instance:")).parent, loaded))
    if source.startswith(("postgresql:", "postgres:")) or _is_sqlite(Path(source)):
        return asyncio.run(known_state(source, loaded, origin))
    return read_state(Path(source), loaded)


def _is_sqlite(path: Path) -> bool:
    try:
        with open_input(path) as file:
            return file.read(16) == b"SQLite format 3\0"
    except (OSError, FileInvalid):
        return False


def _faults(path: Path | None, system: Any) -> tuple[dict[str, Any], ...]:
    if path is None:
        return ()
    from fieldtwin.emulators.faults.schema import load_faults
    from fieldtwin.twin.prototype.fault_aims import target

    return load_faults(path, lambda spec: target(system, spec))
