"""`fieldtwin test`: scenarios, judged; a table for people, JSON, JUnit and HTML for others."""

from __future__ import annotations

import json
import shlex
import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

import click
from rich.markup import escape
from rich.table import Table

from fieldtwin.__about__ import __version__
from fieldtwin.cli.options import Secret, json_option, profiles_option
from fieldtwin.cli.talk import data
from fieldtwin.cli.template_question import consent, trust_option
from fieldtwin.conformance.case import Danger
from gateway.core.errors import UsageError

if TYPE_CHECKING:
    from fieldtwin.report.model import Machine
    from twin.system import System

SUFFIX = ".scenario.yaml"
_COLOUR = {"passed": "green", "failed": "red", "error": "red", "inconclusive": "yellow", "skipped": "yellow"}


@click.command("test")
@click.argument("files", nargs=-1, type=click.Path(exists=True))
@click.option(
    "--target",
    type=click.Choice(["virtual", "local", "compose", "real"]),
    default="virtual",
    show_default=True,
    help="Virtual time; processes on this host; containers; a plant.",
)
@click.option(
    "--allow",
    type=click.Choice([danger.value for danger in Danger]),
    default=Danger.READ.value,
    show_default=True,
    help="With --target real: what steps may do at most.",
)
@click.option("--instance", default="", help="With compose, real: what runs on this host under that name.")
@click.option("--field", "field_host", default="field", metavar="HOST[:PORT]", help="With compose: the field side.")
@click.option(
    "--token",
    type=Secret(),
    default="",
    metavar="@FILE",
    help="Token of that field side's control channel; or in FIELDTWIN_TEST_TOKEN.",
)
@click.option("--far", default="", metavar="ENDPOINT", help="With real: where the far modem is, for `send`.")
@click.option(
    "--capture",
    type=click.Path(exists=True, dir_okay=False),
    help="With --instance: the file that its wires are captured to.",
)
@click.option(
    "--can",
    default="",
    metavar="INTERFACE/CHANNEL",
    help="With local: emulated CAN buses on this interface, e.g. socketcan/vcan0.",
)
@click.option("--waivers", type=click.Path(exists=True, dir_okay=False), help="Failures that somebody answers for.")
@click.option("--seed", type=int, default=None, help="Another seed than the scenario's.")
@click.option("--junit", type=click.Path(dir_okay=False), help="JUnit XML to this file.")
@click.option("--html", type=click.Path(dir_okay=False), help="One page with verdicts and diagrams to this file.")
@click.option(
    "--trace", type=click.Path(dir_okay=False), help="Every event of a single scenario to this file (JSON lines)."
)
@trust_option
@profiles_option
@json_option
def command(
    files: tuple[str, ...],
    target: str,
    allow: str,
    instance: str,
    field_host: str,
    token: str,
    far: str,
    capture: str | None,
    can: str,
    waivers: str | None,
    seed: int | None,
    junit: str | None,
    html: str | None,
    trace: str | None,
    trust: bool,
    profiles: tuple[str, ...],
    as_json: bool,
) -> int:
    """Run the scenarios in FILES (*.scenario.yaml; of a folder all that are in it; without FILES those of this folder).

    The exit code is 0 when all passed and 1 otherwise: a scenario that was skipped or stayed inconclusive has not passed.

    
    --target local       gateway, PLC and emulators as processes, on ptys and sockets of this host
    --target compose     what runs already, judged beside it: docker compose exec controller fieldtwin test ...
    --target real        the plant: no faults, nothing set, read-only without --allow write
    """
    from fieldtwin.conformance.waivers import Waivers, load_waivers
    from fieldtwin.report.model import Report, ScenarioResult
    from fieldtwin.running.scenario_targets import Target, run_scenario
    from fieldtwin.running.template_scenarios import agree_to_scenario
    from fieldtwin.scenarios.form import load_scenario
    from fieldtwin.scenarios.waiving import all_well, ids_of, waive

    paths = _found(files)
    if trace and len(paths) != 1:
        raise UsageError("--trace belongs to one scenario", got=f"{len(paths)} of them")
    _check(target, allow, instance, far, capture, can)
    folders = tuple(map(Path, profiles))
    for path in paths:
        agree_to_scenario(consent(trust=trust), path, folders, plant=target == "real", virtual=target == "virtual")
    scenarios = [load_scenario(path, folders) for path in paths]
    known = [id for one in scenarios for id in ids_of(one.path, one.form.scenario)]
    waived = load_waivers(Path(waivers), known) if waivers else Waivers()
    where = Target(
        target, seed, instance, field_host, token, far, Path(capture) if capture else None, Danger(allow), can
    )
    results: list[ScenarioResult] = []
    for scenario in scenarios:
        result = run_scenario(scenario, where, Path(trace) if trace else None)
        results.append(waive(result, waived, datetime.now(UTC).date()))
        if not as_json:
            _show(results[-1])
    report = Report(
        "scenarios",
        results,
        scenarios[0].system,
        target,
        seed,
        reproduce=shlex.join(["fieldtwin", *sys.argv[1:]]),
        versions={"fieldtwin": __version__},
        machines=_machines([one.system for one in scenarios]) if html else (),
        served=(),
    )
    if junit:
        from fieldtwin.report.junit import write_junit

        write_junit(report, Path(junit))
    if html:
        from fieldtwin.report.html import write_html

        write_html(report, Path(html))
    if as_json:
        json.dump([_plain(result) for result in results], sys.stdout, indent=2)
        sys.stdout.write("\n")
    else:
        counts = ", ".join(f"{n} {verdict.value}" for verdict, n in report.counts.items() if n)
        data.print(f"[bold]{counts}[/bold]")
    return 0 if all_well(results) else 1


def _check(target: str, allow: str, instance: str, far: str, capture: str | None, can: str) -> None:
    if can and target != "local":
        raise UsageError("--can goes with --target local", got=f"--target {target}")
    if target != "real" and (far or allow != Danger.READ.value):
        raise UsageError("--far and --allow go with --target real", got=f"--target {target}")
    if target in ("virtual", "local") and instance:
        raise UsageError("--instance names what runs already", expected="--target compose or real")
    if capture and target != "compose" and not instance:
        raise UsageError(
            "--capture is of what runs already", expected="--target compose, or --target real --instance NAME"
        )


def _found(files: tuple[str, ...]) -> list[Path]:
    paths: list[Path] = []
    for name in files or (".",):
        path = Path(name)
        paths += sorted(path.rglob(f"*{SUFFIX}")) if path.is_dir() else [path]
    if not paths:
        raise UsageError("no scenarios", expected=f"files that end in {SUFFIX}")
    return paths


def _show(result: object) -> None:
    from fieldtwin.report.model import ScenarioResult, Verdict

    assert isinstance(result, ScenarioResult)
    colour = _COLOUR[result.verdict.value]
    took = f"[dim]{result.simulated_s:g} s in {result.took_s:.1f} s[/dim]"
    data.print(f"[{colour}]{result.verdict.value}[/{colour}]  {escape(result.title)}  {took}", soft_wrap=True)
    if result.verdict is Verdict.PASSED:
        return
    if result.reason:
        data.print(f"  {escape(result.reason)}", soft_wrap=True)
    table = Table(box=None, show_header=False, pad_edge=False)
    for check in result.checks:
        if check.verdict is not Verdict.PASSED:
            table.add_row("  expected", escape(check.expected))
            table.add_row("  got", escape(check.got))
            table.add_row("  at", f"{(check.t_ns or 0) / 1e9:.3f} s, {escape(check.where)}")
    if table.row_count:
        data.print(table)
    data.print(f"  {escape(result.reproduce)}", soft_wrap=True)


def _plain(result: object) -> dict[str, object]:
    from fieldtwin.report.model import ScenarioResult

    assert isinstance(result, ScenarioResult)
    return {
        "name": result.name,
        "case": result.case,
        "role": result.role,
        "danger": result.danger,
        "verdict": result.verdict.value,
        "seed": result.seed,
        "target": result.target,
        "reason": result.reason,
        "requirements": list(result.requirements),
        "simulated_s": result.simulated_s,
        "trace": result.trace_hash,
        "reproduce": result.reproduce,
        "checks": [
            {
                "number": c.number,
                "text": c.text,
                "verdict": c.verdict.value,
                "t_s": None if c.t_ns is None else c.t_ns / 1e9,
                "expected": c.expected,
                "got": c.got,
                "where": c.where,
            }
            for c in result.checks
        ],
    }


def _machines(systems: list[System]) -> tuple[Machine, ...]:
    """The state machines of what was under test; of two of one name in different systems the first's."""
    from fieldtwin.report.machines import machines_of

    different = {system.hash: system for system in reversed(systems)}
    return tuple({m.variable: m for system in different.values() for m in machines_of(system)}.values())
