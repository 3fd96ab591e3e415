"""`fieldtwin reload`: a running instance reads its files again between two polls."""

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
@click.option("--check", is_flag=True, help="Only say what is otherwise, and whether it could be taken over.")
@json_option
def command(instance: str, check: bool, as_json: bool) -> int:
    """Let a running INSTANCE read its system file and profiles again; without a name, the only one that runs.

    Periods, time-outs, retries, pauses, limits, scaling, safe values and what may be written change between two polls, none of
    which is lost or doubled. Ports, addresses, devices and programs need a restart: they are named, nothing is changed then, and
    the exit code is 1. So is a program's file (.st, .xml, .py) that changed since the PLC read it. A file that is not right
    changes nothing either (3).
    """
    from fieldtwin.console import show_warnings
    from fieldtwin.gateway.core.control import RemoteError
    from fieldtwin.run.processes.reloading import reload_instance

    try:
        done = asyncio.run(reload_instance(instance, _who(), check=check))
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
        return "Nothing is otherwise in the files."
    if check:
        return f"{changes} change{'' if changes == 1 else 's'}, which can be taken over while it runs."
    return f"{changes} change{'' if changes == 1 else 's'} taken over." if applied else "Nothing was changed."


def _who() -> str:
    try:
        return f"reload by {getpass.getuser()}"
    except (KeyError, OSError):  # a user without a name, in a container
        return f"reload by {os.getuid() if hasattr(os, 'getuid') else 'nobody'}"


class _NotReloaded(FieldtwinError):
    """The instance rejected the reload and gave the reason; this command ends with the instance's exit code."""

    def __init__(self, message: str, remote_exit_code: int) -> None:
        super().__init__(message)
        self.remote_exit_code = remote_exit_code
