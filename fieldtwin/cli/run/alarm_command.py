"""`fieldtwin alarm`: the alarm list of a running instance, acknowledgement and shelving."""

from __future__ import annotations

import asyncio
import getpass
import json
import sys
from typing import Any

import click
import msgspec

from fieldtwin.cli.options import Duration, json_option
from fieldtwin.cli.plc.plc_command import instance_argument, instance_option
from fieldtwin.gateway.core.errors import UsageError


@click.group("alarm")
def command() -> None:
    """Show the alarm list of a running instance, and acknowledge or shelve alarms.

    Alarms are stated in the section `alarms` of the system file. Acknowledging and shelving write nothing to the plant. Both are
    in the instance's audit log, with the user's name.
    """


@command.command("list")
@click.option("--all", "everything", is_flag=True, help="Also list alarms that are normal.")
@instance_argument
@json_option
def list_alarms(everything: bool, instance: str, as_json: bool) -> int:
    """List the alarms that are not normal or whose condition is unknown, the most important first."""
    from fieldtwin.cli.run.alarms_view import alarm_table, standing
    from fieldtwin.console import stderr, stdout
    from fieldtwin.gateway.runtime.gateway_status import AlarmStatus

    alarms = msgspec.convert(_call(instance, "get", brief=True)["alarms"], dict[str, AlarmStatus])
    shown = alarms if everything else standing(alarms)
    if as_json:
        json.dump(msgspec.to_builtins(shown), sys.stdout, indent=2)
        sys.stdout.write("\n")
    elif shown:
        stdout.print(alarm_table(shown))
    elif alarms:
        stderr.print(f"all {len(alarms)} alarms are normal")
    else:
        raise UsageError("the system file of this instance has no `alarms`")
    return 0


@command.command("acknowledge")
@click.argument("names", metavar="NAME...", nargs=-1, required=True)
@instance_option
def acknowledge(names: tuple[str, ...], instance: str) -> int:
    """Acknowledge the alarms NAME."""
    for name in names:
        _act(instance, "acknowledge", alarm=name)
    return 0


@command.command("shelve")
@click.argument("name")
@click.option("--for", "for_s", type=Duration(), required=True, help="How long, such as 30min; at most 24h.")
@instance_option
def shelve(name: str, for_s: float, instance: str) -> int:
    """Suppress the alarm NAME for a time. Afterwards it is normal, or active and not acknowledged."""
    return _act(instance, "shelve", alarm=name, for_s=for_s)


@command.command("unshelve")
@click.argument("name")
@instance_option
def unshelve(name: str, instance: str) -> int:
    """End the shelving of the alarm NAME."""
    return _act(instance, "unshelve", alarm=name)


def _act(instance: str, command: str, **args: Any) -> int:
    """Send a command in the name of the user, and print the new state of the alarm."""
    status = _call(instance, command, by=getpass.getuser(), **args)
    click.echo(f"{args['alarm']}: {status['state'].replace('_', ' ')}")
    return 0


def _call(instance: str, command: str, **args: Any) -> Any:
    from fieldtwin.gateway.core.control import ControlClient
    from fieldtwin.run.processes.plc_client import choose

    async def main() -> Any:
        client = await ControlClient.connect_unix(choose(instance).with_name("gateway.sock"))
        try:
            return await client.call(command, **args)
        finally:
            await client.aclose()

    return asyncio.run(main())
