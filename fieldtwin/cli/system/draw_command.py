"""`fieldtwin draw`: draw the buses of a system with their devices, as text or as SVG."""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

from fieldtwin.cli.completions import systems
from fieldtwin.cli.options import json_option, profiles_option
from fieldtwin.gateway.core.errors import UsageError


@click.command("draw")
@click.argument("system", shell_complete=systems)
@click.option("--prototype", is_flag=True, help="Also show what is emulated, from which source, and at which endpoint.")
@click.option(
    "-o",
    "--output",
    type=click.Path(dir_okay=False, allow_dash=True, path_type=Path),
    help="Write an SVG to this file; - is stdout.",
)
@profiles_option
@json_option
def command(system: str, prototype: bool, output: Path | None, profiles: tuple[Path, ...], as_json: bool) -> int:
    """Draw the buses of SYSTEM with their devices: as text, or with -o as SVG, which follows the reader's light or dark theme.
    For a network, such as `ocean_network`: the positions of its systems, and which of them hear each other.

    The command only reads the files: it opens no connection and runs no control logic.
    """
    from fieldtwin.reports.drawing.svg import svg
    from fieldtwin.reports.drawing.tree import tree
    from fieldtwin.reports.drawing.wiring import wiring
    from fieldtwin.run.template import system_file
    from fieldtwin.run.virtual.group_kinds import kind_named
    from fieldtwin.twin.prototype.file import load_prototype
    from fieldtwin.twin.prototype.group import load_group
    from fieldtwin.twin.site.system import load_system

    if as_json and output is not None:
        raise UsageError("--json and -o exclude each other", expected="one of them")
    if (group := load_group(system, profiles)) is not None:
        drawn = kind_named(group.kind).drawing(group)
        return _put(drawn.data, drawn.text, drawn.svg, output, as_json)
    loaded = load_system(system_file(system, lambda _: True, plant=False), profiles)
    wires = wiring(loaded, load_prototype(loaded) if prototype else None)
    return _put(wires.as_data(), tree(wires, *_room()), lambda: svg(wires), output, as_json)


def _put(facts: Any, text: str, svg: Callable[[], str], output: Path | None, as_json: bool) -> int:
    """Write the drawing to `output` or to stdout: `text`, the SVG if `output` is a file, or `facts` as JSON.

    Raises `UsageError` for a file that cannot be written.
    """
    if as_json:
        text = json.dumps(facts, indent=2) + "\n"
    elif output is not None:
        text = svg()
    if output is None or str(output) == "-":
        sys.stdout.write(text)
        return 0
    try:
        output.write_text(text, encoding="utf-8")
    except OSError as e:
        raise UsageError(f"cannot write {output}: {e.strerror}") from e
    return 0


def _room() -> tuple[int, ...]:
    """Return the terminal's width in columns as a tuple, empty for a pipe, in which lines are not shortened."""
    return (shutil.get_terminal_size().columns,) if sys.stdout.isatty() else ()
