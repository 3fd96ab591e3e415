"""`fieldtwin plc diagram`: draw the state machine of a program."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import click

from fieldtwin.cli.completions import systems
from fieldtwin.cli.option_groups import group
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
from fieldtwin.gateway.core.errors import UsageError

if TYPE_CHECKING:
    from fieldtwin.plc.diagram import Drawable
    from fieldtwin.plc.st.state_diagram import StateDiagram
    from fieldtwin.twin.site.system import System


@click.command("diagram")
@click.argument("source", shell_complete=systems)
@click.option(
    "--program", default="", metavar="NAME", help="The program or POU; default: the only one with a state machine."
)
@click.option("-o", "--output", type=click.Path(dir_okay=False, path_type=Path), help="Output file; default: stdout.")
@group("Options", dialect_option, library_option, sources=TemplateSearchOptions)
def diagram(
    source: str,
    program: str,
    output: Path | None,
    dialect: str | None,
    libraries: tuple[Path, ...],
    sources: TemplateSearchOptions,
) -> int:
    """Draw the state machine of a program of SOURCE as SVG.

    SOURCE is a file or folder of Structured Text, PLCopen XML or TwinCAT, or a system. The state machine is the state table of a
    Python program, or in Structured Text a sequential function chart, or a CASE over a variable that its branches assign: each
    assignment of a state is a transition, and the condition around it is its label.

    \b
    fieldtwin plc diagram pump.st -o pump.svg
    fieldtwin plc diagram observatory --program relay
    """
    from fieldtwin.plc.diagram import svg

    file = source_file(source, dialect, libraries)
    found: Mapping[str, Drawable]
    if file is not None:
        title, found = Path(source).name, _of_file(file)
    else:
        system = agreed_system(source, sources)
        title, found = system.name, _of_system(system)
        if program and program not in system.plc.programs and program not in found:
            raise UsageError(f"no program {program!r}", expected=", ".join(system.plc.programs))
    name, machine = _chosen(found, program, source)
    for pos in getattr(machine, "computed", ()):
        where = f"{pos.path}:{pos.line}:{pos.column}"
        stderr.print(f"{where}: not drawn: the next state is computed", style="yellow", soft_wrap=True, markup=False)
    drawn = svg(machine, f"{title}: {name}")
    if output is None:
        sys.stdout.write(drawn)
    else:
        write_text(output, drawn)
    return 0


def _of_file(source: StSource) -> dict[str, StateDiagram]:
    """Return the state machines of a source by the name of their POU, with the variable if a POU has several."""
    from fieldtwin.plc.st.project import compile_source
    from fieldtwin.plc.st.state_diagram import state_diagrams

    found = list(state_diagrams(compile_source(*source).source))  # an error in the source is reported, and not drawn
    pous = [machine.pou for machine in found]
    return {m.pou if pous.count(m.pou) == 1 else f"{m.pou}.{m.variable}": m for m in found}


def _of_system(system: System) -> dict[str, Drawable]:
    """Return the state machines of a system: by program, and by POU if a program's source has several."""
    from fieldtwin.run.processes.plc_client import programs, table_of

    found: dict[str, Drawable] = {}
    in_text = st_sources(system)
    for name, source in in_text.items():
        machines = _of_file(source)
        if len(machines) == 1:
            found[name] = next(iter(machines.values()))
        else:
            found.update(machines)
    if len(in_text) < len(system.plc.programs):
        tables = {name: table_of(program) for name, program in programs(system).items() if name not in in_text}
        found.update({name: table for name, table in tables.items() if table is not None})
    return found


def _chosen(found: Mapping[str, Drawable], name: str, source: str) -> tuple[str, Drawable]:
    """Return the state machine with this name, or the only one. Raises `UsageError` unless exactly one qualifies."""
    if not found:
        raise UsageError(
            "no program has a state machine",
            where=source,
            expected="a StateTable in Python, or a CASE over a variable that its branches assign",
            hint="see docs/how-to/state-machines.md",
        )
    if name:
        by_name = {each.lower(): each for each in found}
        if name.lower() not in by_name:
            raise UsageError(f"{name!r} has no state machine", expected=", ".join(found))
        name = by_name[name.lower()]
        return name, found[name]
    if len(found) > 1:
        raise UsageError("several programs have a state machine", expected="--program NAME", got=", ".join(found))
    return next(iter(found.items()))
