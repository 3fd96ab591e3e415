"""`fieldtwin doctor`: check what this computer supports, and name what to change."""

from __future__ import annotations

import json
import sys

import click

from fieldtwin.cli.options import json_option
from fieldtwin.console import stdout
from fieldtwin.doctor.checks import examine
from fieldtwin.doctor.verdicts import DoctorCheck, HostVerdict

MARK = {
    HostVerdict.OK: "[green]ok[/green]  ",
    HostVerdict.NOTE: "[yellow]note[/yellow]",
    HostVerdict.BAD: "[red]bad[/red] ",
}


@click.command("doctor")
@json_option
def command(as_json: bool) -> int:
    """Check Python, shipped data, ports, CAN, real-time limits, processors, clock, files and disk. Exit code 1 if a check
    fails.
    """
    checks = examine()
    if as_json:
        json.dump(
            [{"check": c.name, "verdict": c.verdict.value, "found": c.found, "advice": c.advice} for c in checks],
            sys.stdout,
            indent=2,
        )
        sys.stdout.write("\n")
    else:
        for check in checks:
            _show(check)
    return 1 if any(c.verdict is HostVerdict.BAD for c in checks) else 0


def _show(check: DoctorCheck) -> None:
    stdout.print(f"{MARK[check.verdict]} {check.name:<16} {check.found}", soft_wrap=True)
    if check.advice:
        stdout.print(f"{'':21}{check.advice}", soft_wrap=True)
