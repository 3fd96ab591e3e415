"""`fieldtwin approve`: a user confirms or refuses a write that a language-model agent has proposed."""

from __future__ import annotations

import asyncio
import json
import os
import sys
from pathlib import Path

import click
import msgspec
from rich.table import Table
from rich.text import Text

from fieldtwin.cli.options import json_option
from fieldtwin.console import stderr, stdout
from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.errors import CheckFailed, NotAllowed, UsageError
from fieldtwin.gateway.wallclock import WallClock
from fieldtwin.run.proposals.folder import ProposalFolder
from fieldtwin.run.proposals.judging import as_text, confirm, judge_again, number_text
from fieldtwin.run.proposals.proposal import Proposal, Seen


@click.command("approve")
@click.argument("number", type=click.IntRange(1), required=False)
@click.option("--refuse", is_flag=True, help="Refuse the proposal without a question; this needs no terminal.")
@json_option
def command(number: int | None, refuse: bool, as_json: bool) -> int:
    """Confirm or refuse a write to a plant that a language-model agent has proposed. Without NUMBER, list the proposals.

    The command shows the plant, the tag, its present value and the proposed value, and who asked. It reads the answer from a
    terminal only. The answer no refuses the proposal; after Ctrl-C it still waits. A proposal expires after 10 minutes.

    \b
    fieldtwin approve
    fieldtwin approve 3
    fieldtwin approve 3 --refuse
    """
    folder = ProposalFolder(WallClock())
    if number is None:
        if refuse:
            raise UsageError("--refuse needs the number of a proposal")
        return _list(folder, as_json)
    if as_json:
        raise UsageError("--json lists the proposals, without NUMBER")
    proposal = folder.open(number)
    if refuse:
        folder.refuse(proposal, "refused", _user())
        stdout.print(f"proposal {number} is refused")
        return 0
    return _decide(folder, proposal)


def _list(folder: ProposalFolder, as_json: bool) -> int:
    waiting = folder.waiting()
    if as_json:
        click.echo(json.dumps(msgspec.to_builtins(waiting)))
        return 0
    if not waiting:
        stderr.print("no proposal waits")
        return 0
    now_ns = WallClock().monotonic_ns()
    table = Table("number", "plant", "tag", "value", "asked by", "expires in", box=None, pad_edge=False)
    for p in waiting:
        value = f"{as_text(p.seen)} → {number_text(p.value)} {p.unit}".rstrip()
        table.add_row(*map(Text, (str(p.number), p.instance, p.tag, value, p.by, _seconds(p.expires_ns - now_ns))))
    stdout.print(table)
    stderr.print("fieldtwin approve NUMBER shows one, and asks")
    return 0


def _decide(folder: ProposalFolder, proposal: Proposal) -> int:
    if not sys.stdin.isatty() or not sys.stderr.isatty():
        raise NotAllowed(
            "a proposed write is confirmed in a terminal only", hint=f"fieldtwin approve {proposal.number} --refuse"
        )
    seen = asyncio.run(judge_again(proposal))
    _show(proposal, seen)
    question = f"Write {number_text(proposal.value)} to {proposal.tag} of the plant {proposal.instance}?"
    if not click.confirm(question, default=False, err=True):
        folder.refuse(proposal, "refused", _user())
        stdout.print(f"proposal {proposal.number} is refused; nothing was written")
        return 0
    ended = asyncio.run(confirm(folder, proposal, seen, _user()))
    if ended.state == "failed":
        raise CheckFailed(f"{proposal.tag} was not written: {ended.text}")
    stdout.print(Text(f"{proposal.tag}: {ended.text}, written"))
    return 0


def _show(proposal: Proposal, seen: Seen) -> None:
    now_ns = WallClock().monotonic_ns()
    rows = {
        "plant": proposal.instance,
        "tag": proposal.tag,
        "write": f"{as_text(seen)} → {number_text(proposal.value)} {proposal.unit}".rstrip(),
        "asked by": f"{proposal.by}, {_seconds(now_ns - proposal.asked_ns)} ago",
        "expires in": _seconds(proposal.expires_ns - now_ns),
    }
    if proposal.reason:
        rows["reason"] = f"{proposal.reason}  (the agent's words)"
    for name, text in rows.items():
        stderr.print(Text.assemble((f"{name:<11}", "bold"), text), soft_wrap=True)
    if seen != proposal.seen:
        changed = f"The value was {as_text(proposal.seen)} when the agent proposed the write."
        stderr.print(Text(changed, "yellow"), soft_wrap=True)


def _seconds(ns: int) -> str:
    seconds = max(0, ns // NS_PER_S)
    return f"{seconds} s" if seconds < 60 else f"{seconds // 60} min {seconds % 60} s"


def _user() -> str:
    """Return the user's account, which no environment variable can change, and the terminal."""
    import pwd  # here, because other systems than Unix lack it

    try:
        name = pwd.getpwuid(os.getuid()).pw_name
    except KeyError:  # in a container the user may have no name
        name = str(os.getuid())
    terminal = Path(os.ttyname(0)).relative_to("/dev") if sys.stdin.isatty() else "without a terminal"
    return f"user {name} {terminal}"
