"""`fieldtwin plc diagram`: draw a chart, a ladder or function block diagram, or the state machine of a program."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping
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
    from fieldtwin.plc.st.drawing.drawings import Drawing
    from fieldtwin.plc.st.syntax import tree
    from fieldtwin.twin.site.system import System


@click.command("diagram")
@click.argument("source", shell_complete=systems)
@click.option(
    "--program", default="", metavar="NAME", help="The program, POU or POU.ACTION; default: the only one that is drawn."
)
@click.option(
    "--network", type=click.IntRange(1), metavar="N", help="Draw only this network of a body in LD or FBD, from 1."
)
@click.option("-o", "--output", type=click.Path(dir_okay=False, path_type=Path), help="Output file; default: stdout.")
@group("Options", dialect_option, library_option, sources=TemplateSearchOptions)
def diagram(
    source: str,
    program: str,
    network: int | None,
    output: Path | None,
    dialect: str | None,
    libraries: tuple[Path, ...],
    sources: TemplateSearchOptions,
) -> int:
    """Draw a program of SOURCE as SVG.

    SOURCE is a file or folder of Structured Text, PLCopen XML or TwinCAT, or a system. The command draws a sequential function
    chart; a body in LD or FBD of a PLCopen XML file, with its positions in the file; the state table of a Python program; or the
    state machine of a CASE over a variable that its branches assign.

    \b
    fieldtwin plc diagram pump.st -o pump.svg
    fieldtwin plc diagram plant.xml --program Main --network 2 -o rung.svg
    fieldtwin plc diagram observatory --program relay
    """
    file = source_file(source, dialect, libraries)
    found: Mapping[str, Drawing | Drawable]
    if file is not None:
        title, found = Path(source).name, _of_file(file)
    else:
        system = agreed_system(source, sources)
        title, found = system.name, _of_system(system)
        if program and program not in system.plc.programs and program not in found:
            raise UsageError(f"no program {program!r}", expected=", ".join(system.plc.programs))
    name, chosen = _chosen(found, program, source)
    drawn = _svg(chosen, f"{title}: {name}", network or 0)
    if output is None:
        sys.stdout.write(drawn)
    else:
        write_text(output, drawn)
    return 0


def _svg(chosen: Drawing | Drawable, title: str, network: int) -> str:
    from fieldtwin.plc.diagram import svg
    from fieldtwin.plc.st.drawing.drawings import Drawing

    if isinstance(chosen, Drawing):
        return chosen.svg(title, network)
    if network:
        raise UsageError(f"{title} is a state machine, which has no networks")
    for pos in getattr(chosen, "computed", ()):
        where = f"{pos.path}:{pos.line}:{pos.column}"
        stderr.print(f"{where}: not drawn: the next state is computed", style="yellow", soft_wrap=True, markup=False)
    return svg(chosen, title)


def _of_file(source: StSource) -> dict[str, Drawing | Drawable]:
    """Return what can be drawn of a source by the name of its POU, with the action or the variable if a POU has several."""
    from fieldtwin.plc.st.project import compile_source

    parts = list(_parts(compile_source(*source).source))  # an error in the source is reported, and not drawn
    pous = [pou for pou, _, _ in parts]
    return {pou if pous.count(pou) == 1 or not part else f"{pou}.{part}": drawing for pou, part, drawing in parts}


def _parts(unit: tree.SourceUnit) -> Iterator[tuple[str, str, Drawing | Drawable]]:
    """Yield the drawings and the state machines of a unit, each with its POU and its action or variable."""
    from fieldtwin.plc.st.drawing.drawings import drawings_of
    from fieldtwin.plc.st.state_diagram import state_diagrams

    yield from ((one.pou, one.action, one) for one in drawings_of(unit))
    yield from ((one.pou, one.variable, one) for one in state_diagrams(unit) if one.variable)


def _of_system(system: System) -> dict[str, Drawing | Drawable]:
    """Return what can be drawn of a system: by program, and by POU if a program's source has several parts."""
    from fieldtwin.run.processes.plc_client import programs, table_of

    found: dict[str, Drawing | Drawable] = {}
    in_text = st_sources(system)
    for name, source in in_text.items():
        parts = _of_file(source)
        if len(parts) == 1:
            found[name] = next(iter(parts.values()))
        else:
            found.update(parts)
    if len(in_text) < len(system.plc.programs):
        tables = {name: table_of(program) for name, program in programs(system).items() if name not in in_text}
        found.update({name: table for name, table in tables.items() if table is not None})
    return found


def _chosen(found: Mapping[str, Drawing | Drawable], name: str, source: str) -> tuple[str, Drawing | Drawable]:
    """Return the drawing with this name, or the only one. Raises `UsageError` unless exactly one qualifies."""
    if not found:
        raise UsageError(
            "no program has a chart, a body in LD or FBD, or a state machine",
            where=source,
            expected="a StateTable in Python, or a CASE over a variable that its branches assign, if there is no drawing",
            hint="see docs/how-to/state-machines.md",
        )
    if name:
        by_name = {each.lower(): each for each in found}
        if name.lower() not in by_name:
            raise UsageError(f"nothing to draw has the name {name!r}", expected=", ".join(found))
        name = by_name[name.lower()]
        return name, found[name]
    if len(found) > 1:
        raise UsageError("several programs can be drawn", expected="--program NAME", got=", ".join(found))
    return next(iter(found.items()))
