"""`fieldtwin plc`: inspect the PLC of a running instance, force tags, single-step; draw and prove its programs."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from typing import Any

import click
import msgspec

from fieldtwin.cli.options import NegativeNumbers, json_option
from fieldtwin.cli.plc.check_command import check
from fieldtwin.cli.plc.debug_command import debug
from fieldtwin.cli.plc.diagram_command import diagram
from fieldtwin.cli.plc.prove_command import prove
from fieldtwin.cli.plc.trace_command import trace
from fieldtwin.console import stderr
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.plc.status import PlcStatus

instance_option = click.option(
    "--instance", default="", metavar="NAME", help="Name of the instance; default: the only running one."
)


def _one_instance(ctx: click.Context, parameter: click.Parameter, named: str) -> str:
    """Return the instance that --instance or the argument INSTANCE names. The argument is not passed to the command."""
    argument: str = ctx.params.pop("named_instance", "")
    if named and argument and named != argument:
        raise UsageError(f"two instances: {argument!r} and {named!r}", expected="one of them")
    return named or argument


def instance_argument(function: Callable[..., int]) -> Callable[..., int]:
    """Add the argument INSTANCE, which `fieldtwin reload` also has, and the option --instance with the same meaning."""
    argument = click.argument("named_instance", metavar="[INSTANCE]", default="", is_eager=True)
    option = click.option(
        "--instance", default="", metavar="NAME", callback=_one_instance, help="The same as INSTANCE."
    )
    return argument(option(function))


yes_option = click.option("--yes", is_flag=True, help="Do not ask.")


@click.group("plc")
def command() -> None:
    """Inspect the soft PLC: status, tags, forces, single steps, reasons, diagrams and proofs; check programs.

    Forces, pauses and restarts change the behaviour of a plant. Each asks for confirmation and shows the present and the new
    value; without a terminal it needs --yes. Forces stay until they are removed, and every status lists them.
    """


command.add_command(check)
command.add_command(debug)
command.add_command(diagram)
command.add_command(prove)
command.add_command(trace)


def _emit(value: Any) -> int:
    json.dump(value, sys.stdout, indent=2)
    sys.stdout.write("\n")
    return 0


def _sure(question: str, yes: bool) -> None:
    """Ask for confirmation. Raises `UsageError` without a terminal, `Abort` if the answer is no."""
    if yes:
        return
    if not sys.stdin.isatty():
        raise UsageError(
            f"{question}: there is no terminal for the confirmation", hint="--yes to confirm without a terminal"
        )
    click.confirm(question, abort=True, err=True)


def _status(instance: str, brief: bool) -> dict[str, Any]:
    from fieldtwin.run.processes.plc_client import talk_to

    found = talk_to(instance, lambda client: client.call("get", brief=brief))
    assert isinstance(found, dict)
    return found


def _tags(instance: str, patterns: tuple[str, ...]) -> list[dict[str, Any]]:
    from fieldtwin.cli.plc.views import ask_tags
    from fieldtwin.run.processes.plc_client import talk_to

    return talk_to(instance, lambda client: ask_tags(client, patterns))


def _call(instance: str, command: str, **args: Any) -> Any:
    from fieldtwin.run.processes.plc_client import talk_to

    return talk_to(instance, lambda client: client.call(command, **args))


def _act(instance: str, command: str, **args: Any) -> Any:
    """Send a command that changes the PLC's state, and return the PLC's answer. The PLC records the command with the user's
    name.
    """
    import getpass

    return _call(instance, command, by=getpass.getuser(), **args)


@command.command("status")
@instance_argument
@json_option
def status(instance: str, as_json: bool) -> int:
    """Show the state, the cycle statistics of each task, forces, retained variables and counters."""
    from fieldtwin.cli.plc.views import print_status, tags_as_data

    found = _status(instance, brief=not as_json)
    if as_json:
        return _emit({**found, "tags": tags_as_data(_tags(instance, ()))})
    print_status(msgspec.convert(found, PlcStatus))
    return 0


@command.command("watch")
@click.argument("tags", nargs=-1)
@click.option("--once", is_flag=True, help="Print once and exit.")
@instance_option
@json_option
def watch(tags: tuple[str, ...], once: bool, instance: str, as_json: bool) -> int:
    """Show live values of TAGS (default: all) with unit, limits, quality, age and forces. Ctrl-C ends it.

    Each TAG is a tag, a device or program (all of its tags), or a pattern such as '*.state'. Variables of programs
    that are not tags are shown with their type: members of function blocks and structures, arrays and strings,
    such as control.delay.ET. Name an element of an array as in the source: 'control.levels[3]'.
    """
    import asyncio

    from fieldtwin.cli.plc.views import print_tags, tags_as_data, watch_live
    from fieldtwin.run.processes.plc_client import choose

    if once or as_json or not sys.stdout.isatty():
        rows = _tags(instance, tags)
        if as_json:
            return _emit(tags_as_data(rows))
        print_tags(rows)
        return 0
    asyncio.run(watch_live(choose(instance), tags))
    return 0


@command.command("force", cls=NegativeNumbers)
@click.argument("tag")
@click.argument("value")
@yes_option
@instance_option
def force(tag: str, value: str, yes: bool, instance: str) -> int:
    """Force TAG, an input, an output or a local, to VALUE until it is unforced. VALUE is true, false, a number, or a state's
    name.
    """
    from fieldtwin.cli.plc.views import is_now
    from fieldtwin.run.processes.plc_client import parse_value

    rows = [row for row in _tags(instance, (tag,)) if row["tag"] == tag]
    now = is_now(rows, tag)
    codes = {word: int(code) for code, word in rows[-1]["words"].items()}
    wanted = codes[value] if value in codes else parse_value(value, tuple(codes))
    _sure(f"{tag} is {now}; force it to {value}", yes)
    _act(instance, "force", tag=tag, value=wanted)
    stderr.print(f"{tag} is forced to {value}", markup=False)
    return 0


@command.command("unforce")
@click.argument("tag", required=False)
@click.option("--all", "every", is_flag=True, help="Remove all forces.")
@instance_option
def unforce(tag: str | None, every: bool, instance: str) -> int:
    """Remove the force of TAG. This is the safe direction, so it asks for no confirmation."""
    if bool(tag) == every:
        raise UsageError("no tag to unforce", expected="a TAG, or --all")
    done = _act(instance, "unforce", all=True) if every else _act(instance, "unforce", tag=tag)
    stderr.print(f"{done['removed']} removed", markup=False)
    return 0


@command.command("pause")
@yes_option
@instance_argument
def pause(yes: bool, instance: str) -> int:
    """Pause the execution of programs; the outputs keep their values, and the plant keeps them."""
    _sure("pause the PLC: its outputs keep their values, whatever happens in the plant", yes)
    _act(instance, "pause")
    stderr.print("paused; fieldtwin plc step, fieldtwin plc go")
    return 0


@command.command("go")
@instance_argument
def go(instance: str) -> int:
    """Continue after a pause."""
    _act(instance, "go")
    stderr.print("running")
    return 0


@command.command("step", cls=NegativeNumbers)
@click.argument("count", type=click.IntRange(1, 10_000), default=1)
@instance_option
def step(count: int, instance: str) -> int:
    """While paused, execute COUNT scans (default: 1) of the fastest task, and the scans of other tasks that fall due in that
    time.
    """
    import getpass

    from fieldtwin.run.processes.plc_client import step_and_wait, talk_to

    scans = talk_to(instance, lambda client: step_and_wait(client.call, count, getpass.getuser()))
    texts = [f"{name + ': ' if len(scans) > 1 else ''}{n} scan{'' if n == 1 else 's'}" for name, n in scans.items()]
    stderr.print(", ".join(texts), markup=False)
    return 0


@command.command("restart")
@click.option("--cold", is_flag=True, help="Reset retained variables as well.")
@yes_option
@instance_argument
def restart(cold: bool, yes: bool, instance: str) -> int:
    """Restart the programs: first scan, initial values, and (unless --cold) retained values."""
    _sure(f"restart the PLC {'cold' if cold else 'warm'}: its outputs are safe during the restart", yes)
    stderr.print(_act(instance, "restart", cold=cold)["start"], markup=False)
    return 0


@command.command("why")
@click.argument("tag")
@instance_option
@json_option
def why(tag: str, instance: str, as_json: bool) -> int:
    """Show which program last changed TAG (an output or local), when, and its inputs at that time.

    Without --json it also shows the missing inputs of a program that has not started.
    """
    from fieldtwin.cli.plc.views import print_why

    answer = _call(instance, "why", tag=tag)
    if as_json:
        return _emit(answer["changes"])
    print_why(tag, answer["changes"], answer["waits_for"])
    return 0
