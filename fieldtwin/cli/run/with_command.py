"""`fieldtwin with`: run any command against the simulated field devices of a system."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click
from rich.markup import escape

from fieldtwin.cli.completions import systems
from fieldtwin.cli.option_groups import group
from fieldtwin.cli.run.run_options import ReplayOptions, listen_option
from fieldtwin.cli.template_question import TemplateSearchOptions
from fieldtwin.console import show_warnings, stderr
from fieldtwin.gateway.core.errors import UsageError

LONG = ("_URL", "_TTY", "_BAUDRATE", "_FRAME", "_HOST", "_PORT", "_INTERFACE", "_CHANNEL")
"""Endings of environment variables that repeat parts of a shorter variable. Such variables are not printed."""


@click.command("with", context_settings={"allow_interspersed_args": False})
@click.argument("system", shell_complete=systems)
@click.argument("argv", nargs=-1, type=click.UNPROCESSED, metavar="-- CMD [ARG]...")
@group("Simulated devices", listen_option, replay=ReplayOptions)
@click.option("--faults", default="", metavar="FILE", help="Inject these faults (see fieldtwin faults).")
@click.option("--instance", default="", help="Name of a permanent run directory; default: a temporary one.")
@click.option("--quiet", is_flag=True, help="Do not print the environment.")
@group("Profiles and templates", sources=TemplateSearchOptions)
def command(
    system: str,
    argv: tuple[str, ...],
    listen: dict[str, str],
    replay: ReplayOptions,
    faults: str,
    instance: str,
    quiet: bool,
    sources: TemplateSearchOptions,
) -> int:
    """Run CMD against the simulated field devices of SYSTEM, or of a template, and end with CMD's exit status.

    fieldtwin's gateway and PLC do not run: CMD is the control program, or its test suite. CMD finds the buses by name in its
    environment: FIELDTWIN_LINE1 is a path, HOST:PORT or a CAN channel. Options of this command come before SYSTEM.

    \b
    fieldtwin with observatory -- sh -c \\
        'mbpoll -m rtu -a 1 -b 19200 -P even -t 4 -r 1 -1 $FIELDTWIN_LINE1'
    fieldtwin with --faults silent.yaml observatory -- pytest tests/

    If a signal ends CMD, the exit status is 128 plus its number, as in a shell. If the field simulator ends early, the exit
    status is not 0, even if CMD's is.
    """
    from fieldtwin.gateway.wallclock import run
    from fieldtwin.results.fault_counts import struck_of
    from fieldtwin.run.processes.with_program import run_with
    from fieldtwin.run.template import system_file
    from fieldtwin.twin.prototype.field_process import FieldConfig
    from fieldtwin.twin.prototype.field_status import StruckStatus
    from fieldtwin.twin.site.system import load_system

    words = argv[1:] if argv[:1] == ("--",) else argv
    if not words:
        raise UsageError("`fieldtwin with` needs a command", expected=f"fieldtwin with {system} -- CMD [ARG]...")
    if words[0].startswith("-"):
        raise UsageError(
            f"{words[0]!r} is not a program",
            expected=f"options before SYSTEM: fieldtwin with [OPTION]... {system} -- CMD",
        )
    file = replay.prototype_file
    loaded = load_system(
        system_file(system, sources.ask(), prototype_file=file, profiles=sources.profiles), sources.profiles
    )
    config = FieldConfig(
        system=str(loaded.path.resolve()),
        run_dir="",
        prototype=str(file.resolve()) if file else "",
        profiles=tuple(str(p.resolve()) for p in sources.profiles),
        recordings={d: str(Path(p).resolve()) for d, p in replay.recordings.items()},
        speed=replay.speed,
        listen=listen,
    )
    put_in: tuple[dict[str, Any], ...] = ()
    if faults:
        from fieldtwin.emulators.faults.schema import load_faults
        from fieldtwin.twin.prototype.fault_aims import target

        put_in = load_faults(Path(faults), lambda spec: target(loaded, spec))

    def on_start(env: dict[str, str]) -> None:
        if quiet:
            return
        stderr.print(f"[bold]field simulator[/bold] of {escape(loaded.name)}")
        show_warnings(loaded.warnings)
        for name, value in env.items():
            if name.endswith(LONG):
                continue
            stderr.print(f"  {name}={escape(value)}", soft_wrap=True)

    def on_end(struck: list[StruckStatus]) -> None:
        if not quiet:
            for one in struck:
                stderr.print(f"fault {struck_of(one).text}", soft_wrap=True, markup=False, highlight=False)

    return run(run_with(config, words, instance=instance, faults=put_in, on_start=on_start, on_end=on_end))
