"""`fieldtwin plc prove`: prove invariants of a program, or find the inputs that violate them."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fieldtwin.cli.completions import systems
from fieldtwin.cli.option_groups import GroupedCommand, group, option
from fieldtwin.cli.options import json_option
from fieldtwin.cli.output_files import write_text
from fieldtwin.cli.plc.sources import (
    StSource,
    agreed_system,
    dialect_option,
    library_option,
    source_file,
    st_sources,
)
from fieldtwin.cli.template_question import TemplateSearchOptions
from fieldtwin.console import stderr
from fieldtwin.gateway.core.clock import NS_PER_MS
from fieldtwin.gateway.core.errors import UsageError

if TYPE_CHECKING:
    from fieldtwin.plc.st.model_checking.proof import Report
    from fieldtwin.twin.site.system import System

LONGEST_MS = 3_600_000.0
"""The default of the longest time between two scans: one hour."""


@dataclass(frozen=True)
class ProofOptions:
    """Questions about a program in Structured Text, and the limits of the search."""

    invariants: tuple[str, ...] = option(
        "--invariant",
        metavar="EXPRESSION",
        multiple=True,
        help="An expression in Structured Text over the program's variables that is TRUE after every scan, or NAME: EXPRESSION. "
        "Can be repeated.",
    )
    assumptions: tuple[str, ...] = option(
        "--assume",
        metavar="EXPRESSION",
        multiple=True,
        help="An expression that is TRUE before every scan, such as a limit of an input. Can be repeated.",
    )
    scan_interval: tuple[float, float] | None = option(
        "--scan-interval",
        type=(click.FloatRange(0.001), click.FloatRange(0.001)),
        default=None,
        metavar="MIN MAX",
        help="The shortest and the longest time between two scans in ms (default: 1, or the interval of the task, to 3600000).",
    )
    scans: int = option(
        "--scans",
        type=click.IntRange(1, 10_000),
        default=20,
        show_default=True,
        help="The largest number of scans of a counterexample.",
    )
    time_limit: float = option(
        "--time-limit",
        type=click.FloatRange(0.1),
        default=60.0,
        show_default=True,
        metavar="SECONDS",
        help="Stop the search after this time.",
    )


@click.command("prove", cls=GroupedCommand)
@click.argument("source", shell_complete=systems)
@group(
    "Program",
    click.option(
        "--program", default="", metavar="NAME", help="The program; default: the only one that can be proved."
    ),
)
@group("Programs in Structured Text", dialect_option, library_option, wanted=ProofOptions)
@group(
    "Programs in Python",
    click.option(
        "--max-states", type=click.IntRange(1), default=200_000, show_default=True, help="The largest number of states."
    ),
)
@group(
    "Output",
    click.option(
        "-o",
        "--output",
        type=click.Path(dir_okay=False, path_type=Path),
        help="Write a counterexample to this file, as a scenario of the system.",
    ),
    json_option,
)
@group("Profiles and templates", sources=TemplateSearchOptions)
def prove(
    source: str,
    program: str,
    output: Path | None,
    dialect: str | None,
    libraries: tuple[Path, ...],
    wanted: ProofOptions,
    max_states: int,
    sources: TemplateSearchOptions,
    as_json: bool,
) -> int:
    """Prove the invariants of a program of SOURCE, or find the inputs that violate them.

    SOURCE is a file or folder of Structured Text, PLCopen XML or TwinCAT, or a system.

    \b
    fieldtwin plc prove pump.st --invariant "NOT (motor AND stop)"
    fieldtwin plc prove pump.st --assume "level >= 0 AND level <= 100" --scans 40
    fieldtwin plc prove observatory --program relay

    A program in Structured Text is translated for the solver Z3 (extra `prove`). Each invariant is proved for all scans, or
    violated by the inputs that are listed, or not violated in a limited number of scans. That no scan ends with an error, such as
    a division by zero, is always an invariant. For each state of a state machine the command says whether it is reached, or
    proved to be unreachable. In a system, `invariants:` and `assumptions:` of the program are added.

    For a program in Python, the invariants are those of the PROOF in the module next to it (the program's module name with the
    suffix _proof), and the search executes the program with all inputs that are listed there.

    Exit code 0 if all invariants are proved, else 1.
    """
    file = source_file(source, dialect, libraries)
    if file is not None:
        if output is not None:
            raise UsageError("a file has no scenarios", expected="-o with a system that runs the program")
        return _print(_prove_file(file, program, wanted, {}, {}, 1.0), as_json)
    system = agreed_system(source, sources)
    if (name := _st_program(system, program, wanted)) is None:
        return _prove_python(system, program, max_states, output, as_json)
    form = system.plc.programs[name]
    cycle_ms = _interval_ms(system, form.task)
    report = _prove_file(
        st_sources(system)[name],
        form.source.partition(":")[2].strip(),
        wanted,
        form.invariants,
        form.assumptions,
        cycle_ms,
    )
    if output is not None:
        _write_scenario(system, name, report, output)
    return _print(report, as_json)


def _st_program(system: System, name: str, wanted: ProofOptions) -> str | None:
    """Return the name of the program in Structured Text that is meant; None if a program in Python may be meant.

    Raises `UsageError` if several are possible.
    """
    found = list(st_sources(system))
    if name or not found:
        return name if name in found else None
    if len(found) < len(system.plc.programs) and not wanted.invariants:  # prefer a program with stated invariants
        found = [each for each in found if system.plc.programs[each].invariants]
    if len(found) > 1:
        raise UsageError("several programs can be proved", expected="--program NAME", got=", ".join(found))
    return found[0] if found else None


def _interval_ms(system: System, task: str | None) -> float:
    """Return the interval of a task, or of the first one, in ms; 1 ms for a task that an event starts."""
    tasks = system.plc.tasks
    if not tasks:
        return float(system.plc.cycle_ms)
    return float((tasks[task] if task else next(iter(tasks.values()))).interval_ms or 1)


def _prove_file(
    source: StSource, program: str, wanted: ProofOptions, invariants: dict[str, str], assumptions: dict[str, str],
    shortest_ms: float,
) -> Report:  # fmt: skip
    from fieldtwin.gateway.wallclock import WallClock
    from fieldtwin.plc.st.model_checking.solver import require_solver

    require_solver()
    from fieldtwin.plc.st.model_checking.proof import Limits, Question, prove
    from fieldtwin.plc.st.model_checking.properties import named
    from fieldtwin.plc.st.program import program_class
    from fieldtwin.plc.st.project import compile_source

    unit = compile_source(*source)
    kind = program_class(unit, program)
    shortest, longest = wanted.scan_interval or (shortest_ms, max(shortest_ms, LONGEST_MS))
    if shortest > longest:
        raise UsageError("the shortest time between two scans is above the longest", got=f"{shortest:g} {longest:g}")
    end_ns = WallClock().monotonic_ns() + round(wanted.time_limit * 1e9)
    question = Question(
        unit.source, str(source[0]), kind.__name__, source[1],
        (*invariants.items(), *map(named, wanted.invariants)), (*assumptions.items(), *map(named, wanted.assumptions)),
        (round(shortest * NS_PER_MS), round(longest * NS_PER_MS)), instance=program,
    )  # fmt: skip
    return prove(question, Limits(wanted.scans, lambda: (end_ns - WallClock().monotonic_ns()) / 1e9))


def _print(report: Report, as_json: bool) -> int:
    from fieldtwin.cli.plc.proof_views import print_report, report_as_data

    if as_json:
        click.echo(json.dumps(report_as_data(report), indent=2))
    else:
        print_report(report)
    return 0 if report.proved else 1


def _write_scenario(system: System, name: str, report: Report, output: Path) -> None:
    """Write the first counterexample of a report as a scenario."""
    from fieldtwin.plc.st.program import StProgram
    from fieldtwin.run.processes.plc_client import programs
    from fieldtwin.scenarios.language.st_counterexample import st_scenario

    violated = [result for result in report.invariants if result.answer.way]
    if not violated:
        stderr.print(f"no counterexample, so {output} is not written", markup=False)
        return
    kind = type(programs(system)[name])
    assert issubclass(kind, StProgram)
    write_text(output, st_scenario(system, name, kind, report, violated[0]))
    if len(violated) > 1:
        stderr.print(f"{output} has the counterexample of {violated[0].name!r} only", markup=False, soft_wrap=True)


def _prove_python(system: System, program: str, max_states: int, output: Path | None, as_json: bool) -> int:
    from fieldtwin.cli.plc.proof_views import print_proof
    from fieldtwin.plc.prove import prove as look
    from fieldtwin.run.processes.plc_client import chosen, proof_of
    from fieldtwin.scenarios.language.counterexample import scenario

    name, proof = chosen(system, program, proof_of, "a proof")
    result = look(proof, max_states)
    text = scenario(system, name, proof, result) if result.broken else ""
    if output is not None and text:
        write_text(output, text)
    if as_json:
        found: dict[str, Any] = {
            "program": name,
            "proved": result.proved,
            "states": result.states,
            "transitions": result.transitions,
            "depth": result.depth,
            "invariants": list(proof.invariants),
            "broken": result.broken,
            "reason": result.reason,
            "way": [given.describe() for given in result.way],
        }
        click.echo(json.dumps(found, indent=2))
    else:
        print_proof(name, proof, result, text)
    return 0 if result.proved else 1
