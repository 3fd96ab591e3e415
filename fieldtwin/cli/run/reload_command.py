"""`fieldtwin reload`: a running instance reads its files again between two polls, and its programs between two scans."""

from __future__ import annotations

import asyncio
import getpass
import json
import os
import sys

import click

from fieldtwin.cli.options import json_option
from fieldtwin.gateway.core.errors import FieldtwinError

NEEDS_RESTART = 1


@click.command("reload")
@click.argument("instance", required=False, default="")
@click.option("--check", is_flag=True, help="Only show the changes, and whether they could be applied.")
@click.option("--back", is_flag=True, help="Let the programs run again that the last reload replaced.")
@json_option
def command(instance: str, check: bool, back: bool, as_json: bool) -> int:
    """Let a running INSTANCE read its files again; the default is the only running instance.

    Periods, timeouts, retries, pauses, limits, scaling, safe values and the set of writable tags change between two polls,
    without a lost or repeated poll. Programs in Structured Text whose files changed are replaced between two scans: variables
    and timers whose declarations are unchanged keep their values.

    Ports, addresses, devices, bindings of programs, and programs in Python need a restart: the command names these changes,
    applies none, and exits with code 1. An invalid file changes nothing (exit code 3).
    """
    from fieldtwin.console import show_warnings
    from fieldtwin.gateway.core.control import RemoteError
    from fieldtwin.run.processes.reloading import reload_instance

    try:
        done = asyncio.run(reload_instance(instance, _who(), check=check, back=back))
    except RemoteError as e:
        raise _NotReloaded(f"nothing was changed: {e.message}", e.remote_exit_code) from e
    show_warnings(done.warnings)
    if as_json:
        json.dump({"applied": done.applied, "changes": done.changes, "hash": done.hash}, sys.stdout, indent=2)
        sys.stdout.write("\n")
    else:
        for change in done.changes:
            print(f"{change['where']}: {change['what']}" + ("" if change["live"] else "   (needs a restart)"))
        click.echo(_verdict(done.applied, len(done.changes), len(done.restart), check), err=True)
    return NEEDS_RESTART if done.restart else 0


def _verdict(applied: bool, changes: int, restart: int, check: bool) -> str:
    if restart:
        return f"Nothing was changed: {restart} of {changes} changes need{'s' if restart == 1 else ''} a restart."
    if not changes:
        return "The files have not changed."
    if check:
        return f"{changes} change{'' if changes == 1 else 's'}, which can be applied at run time."
    return f"{changes} change{'' if changes == 1 else 's'} applied." if applied else "Nothing was changed."


def _who() -> str:
    try:
        return f"reload by {getpass.getuser()}"
    except (KeyError, OSError):  # in a container the user may have no name
        return f"reload by {os.getuid() if hasattr(os, 'getuid') else 'nobody'}"


class _NotReloaded(FieldtwinError):
    """The instance rejected the reload and gave the reason; this command ends with the instance's exit code."""

    def __init__(self, message: str, remote_exit_code: int) -> None:
        super().__init__(message)
        self.remote_exit_code = remote_exit_code
