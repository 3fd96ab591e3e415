"""`fieldtwin export fmu`: pack a prototype as an FMU, with which a simulation tool drives the PLC."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import click
from rich.markup import escape

from fieldtwin.cli.completions import systems
from fieldtwin.cli.option_groups import GroupedCommand, group
from fieldtwin.cli.options import json_option
from fieldtwin.cli.template_question import TemplateSearchOptions
from fieldtwin.console import stderr, stdout


@click.command("fmu", cls=GroupedCommand)
@click.argument("system", shell_complete=systems)
@group(
    "FMU",
    click.option(
        "-o",
        "--out",
        type=click.Path(dir_okay=False, path_type=Path),
        help="The FMU; default: the system's name with .fmu, here.",
    ),
    click.option(
        "--input",
        "inputs",
        multiple=True,
        metavar="DEVICE.TAG",
        help="A value of a device that the tool sets; repeatable. Default: each number that a program reads.",
    ),
    click.option("--seed", type=int, default=None, help="The default seed; otherwise the prototype file's."),
    click.option(
        "--python",
        default=sys.executable,
        metavar="FILE",
        show_default="this one",
        help="The Python with fieldtwin on the computer of the tool.",
    ),
    json_option,
)
@group(
    "Simulated devices",
    click.option(
        "--prototype-file",
        type=click.Path(exists=True, dir_okay=False, path_type=Path),
        help="Use this prototype file.",
    ),
)
@group("Profiles and templates", sources=TemplateSearchOptions)
def command(
    system: str,
    out: Path | None,
    inputs: tuple[str, ...],
    seed: int | None,
    python: str,
    as_json: bool,
    prototype_file: Path | None,
    sources: TemplateSearchOptions,
) -> int:
    """Pack the prototype of SYSTEM as an FMU (FMI 2.0, co-simulation), so that a simulation tool drives its PLC.

    The FMU contains the system with profiles and control logic. Gateway, PLC and emulators run in virtual time, as in
    `fieldtwin simulate`, in a process of fieldtwin. The tool therefore needs fieldtwin on its computer, and a Python in its own
    process.

    \b
    fieldtwin export fmu tank --input sensor.level -o plc.fmu

    Inputs are named set.DEVICE.TAG, outputs DEVICE.TAG and PROGRAM.VARIABLE; NAME.good tells whether an output is good.
    """
    from fieldtwin.run.fmu_export.packing import ExportOptions, export_fmu
    from fieldtwin.run.template import system_file
    from fieldtwin.twin.prototype.file import load_prototype
    from fieldtwin.twin.site.system import load_system

    system = system_file(system, sources.ask(), virtual=True, prototype_file=prototype_file, profiles=sources.profiles)
    loaded = load_system(system, sources.profiles)
    prototype = load_prototype(loaded, prototype_file)
    out = out or Path(f"{loaded.name}.fmu")
    interface = export_fmu(loaded, prototype, out, ExportOptions(inputs, seed, python, sources.profiles))
    if as_json:
        described = {
            "fmu": str(out),
            "inputs": [port.name for port in interface.inputs],
            "outputs": [port.name for port in interface.outputs],
        }
        json.dump(described, sys.stdout)
        sys.stdout.write("\n")
        return 0
    stdout.print(
        f"{escape(str(out))}: FMI 2.0, co-simulation; inputs {len(interface.inputs)}, outputs {len(interface.outputs)}",
        soft_wrap=True,
    )
    for port in interface.inputs:
        unit = f", in {port.unit}" if port.unit else ""
        stderr.print(f"  {escape(port.name)}{escape(unit)}", soft_wrap=True)
    return 0
