"""`fieldtwin with`: run any command against the simulated field devices of a system."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click
from rich.markup import escape

from fieldtwin.cli.options import pairs, profiles_option
from fieldtwin.cli.template_question import consent, trust_option
from fieldtwin.console import show_warnings, stderr
from fieldtwin.gateway.core.errors import UsageError

LONG = ("_URL", "_TTY", "_BAUDRATE", "_FRAME", "_HOST", "_PORT", "_INTERFACE", "_CHANNEL")
"""Endings of variables that repeat parts of a shorter variable: they are not shown."""


@click.command("with", context_settings={"allow_interspersed_args": False})
@click.argument("system")
@click.argument("argv", nargs=-1, type=click.UNPROCESSED, metavar="-- CMD [ARG]...")
@click.option("--prototype-file", type=click.Path(exists=True, dir_okay=False), help="Use this prototype file.")
@click.option(
    "--recording", "recordings", multiple=True, metavar="DEVICE=FILE", help="Replay this recording for a device."
)
@click.option("--speed", type=float, default=0.0, help="Speed factor for recordings.")
@click.option("--listen", multiple=True, metavar="BUS=ENDPOINT", help="Endpoint for the emulators of a bus.")
@click.option("--faults", default="", metavar="FILE", help="Inject these faults (see fieldtwin faults).")
@click.option("--instance", default="", help="Name of a permanent run directory; default: a temporary one.")
@click.option("--quiet", is_flag=True, help="Do not print the environment.")
@trust_option
@profiles_option
def command(
    system: str,
    argv: tuple[str, ...],
    prototype_file: str | None,
    recordings: tuple[str, ...],
    speed: float,
    listen: tuple[str, ...],
    faults: str,
    instance: str,
    quiet: bool,
    trust: bool,
    profiles: tuple[str, ...],
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
    from fieldtwin.twin.site.system import load_system

    words = argv[1:] if argv[:1] == ("--",) else argv
    if not words:
        raise UsageError("`fieldtwin with` needs a command", expected=f"fieldtwin with {system} -- CMD [ARG]...")
    folders = [Path(p) for p in profiles]
    file = Path(prototype_file) if prototype_file else None
    loaded = load_system(system_file(system, consent(trust=trust), prototype_file=file, profiles=folders), folders)
    config = FieldConfig(
        system=str(loaded.path.resolve()),
        run_dir="",
        prototype=str(Path(prototype_file).resolve()) if prototype_file else "",
        profiles=tuple(str(Path(p).resolve()) for p in profiles),
        recordings={d: str(Path(p).resolve()) for d, p in pairs(recordings, "--recording").items()},
        speed=speed,
        listen=pairs(listen, "--listen"),
    )
    put_in: tuple[dict[str, Any], ...] = ()
    if faults:
        from fieldtwin.emulators.faults.schema import load_faults
        from fieldtwin.twin.prototype.fault_aims import target

        put_in = load_faults(Path(faults), lambda spec: target(loaded, spec))

    def tell(env: dict[str, str]) -> None:
        if quiet:
            return
        stderr.print(f"[bold]field simulator[/bold] of {escape(loaded.name)}")
        show_warnings(loaded.warnings)
        for name, value in env.items():
            if name.endswith(LONG):
                continue
            stderr.print(f"  {name}={escape(value)}", soft_wrap=True)

    def tell_struck(struck: list[dict[str, Any]]) -> None:
        if not quiet:
            for one in struck:
                stderr.print(f"fault {struck_of(one).text}", soft_wrap=True, markup=False, highlight=False)

    return run(run_with(config, words, instance=instance, faults=put_in, tell=tell, tell_struck=tell_struck))
