"""`fieldtwin run NETWORK`: several systems and the acoustic channel between them, as processes on this host."""

from __future__ import annotations

import asyncio
import json
import signal
import sys
from contextlib import AsyncExitStack
from typing import Any

from rich.console import Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from fieldtwin.acoustic.network import Network
from fieldtwin.acoustic.schema import SHIP
from fieldtwin.acoustic.session import NetworkOptions, NetworkSession
from fieldtwin.acoustic.ship import scripted_commands
from fieldtwin.acoustic.summary import summarise_network
from fieldtwin.cli.run.summary_view import print_faults
from fieldtwin.cli.run.troubles import troubles
from fieldtwin.console import show_warnings, stderr, stdout
from fieldtwin.gateway.core.errors import FieldtwinError, UsageError
from fieldtwin.run.live.session import RunSession
from fieldtwin.run.virtual.group_kinds import LiveRequest

THREAD = "tcp://127.0.0.1:0"
REFRESH_S = 0.25
LINE_S = 5.0
MAX_TROUBLES = 5


def introduce(network: Network) -> None:
    """Print the members of the network on stderr, and which of them hear each other."""
    show_warnings(dict.fromkeys(warning for member in network.members.values() for warning in member.system.warnings))
    sea = network.medium(network.seed)
    stderr.print(f"[bold]network[/bold] {network.name}, prototypes of {len(network.members)} systems", highlight=False)
    for name in network.places:
        heard = ", ".join(sea.neighbours(name)) or "nobody"
        what = f" ({network.members[name].system.name})" if name in network.members else ""
        stderr.print(f"  {name}{what}: hears {heard}", soft_wrap=True, highlight=False)


def run_live(network: Network, request: LiveRequest, *, as_json: bool) -> int:
    """Run the network's systems on this host and return the exit status: 0 if every system passed."""
    if request.thread not in ("", THREAD):
        raise UsageError("each system of a network has a separate thread and port", expected=f"--thread {THREAD}")
    introduce(network)
    return asyncio.run(_on_this_host(network, request, as_json))


async def _on_this_host(network: Network, request: LiveRequest, as_json: bool) -> int:
    options = NetworkOptions(
        request.instance,
        request.duration_s,
        None,
        request.profiles,
        request.cold,
        commands=scripted_commands(network, request.commands, request.duration_s),
        faults=request.faults,
        thread=request.thread,
    )
    session = NetworkSession(network, options)
    interrupted = started = False
    me = asyncio.current_task()
    assert me is not None

    def interrupt() -> None:
        nonlocal interrupted
        interrupted = True
        session.stopped.set()
        if not started:
            me.cancel()

    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, interrupt)
    async with AsyncExitStack() as stack:
        try:
            await stack.enter_async_context(session)
        except (asyncio.CancelledError, FieldtwinError):
            if interrupted:
                return 130
            raise
        started = True
        for name, one in session.sessions.items():
            stderr.print(
                f"  {name}: instance {one.instance.name} in {one.instance.dir}", soft_wrap=True, highlight=False
            )
            if one.thread_place:
                stderr.print(f"  {name}: digital thread  ←  {one.thread_place}", soft_wrap=True, highlight=False)
        if session.ship is not None:
            stderr.print(f"  the ship's modem  →  {session.ship}", soft_wrap=True, highlight=False)
        showing = asyncio.create_task(_show(session, quiet=as_json))
        try:
            await session.wait()
        finally:
            showing.cancel()
            await asyncio.wait([showing])
        elapsed_s = session.elapsed_s
    if not showing.cancelled() and (failed := showing.exception()) is not None:
        raise failed
    systems = {name: one.summary() for name, one in session.sessions.items()}
    summary = summarise_network(network.name, systems, session.results(), [], elapsed_s)
    if as_json:
        json.dump(summary, sys.stdout, indent=2)
        sys.stdout.write("\n")
    else:
        print_network_summary(summary)
    if interrupted and options.duration_s:
        return 130
    return 0 if summary["ok"] else 1


# -- while it runs ------------------------------------------------------------------------------------------------------


async def _show(session: NetworkSession, quiet: bool) -> None:
    """Show a table on a terminal; if the output is not a terminal, print a line for each system at intervals."""
    if quiet:
        return
    if stderr.is_terminal:
        with Live(_table(session), console=stderr, auto_refresh=False, transient=True) as live:
            while True:
                live.update(_table(session), refresh=True)
                await asyncio.sleep(REFRESH_S)
    told: set[str] = set()
    while True:
        await asyncio.sleep(LINE_S)
        now = _troubles(session)
        for trouble in now:
            if trouble not in told:
                stderr.print(f"! {trouble}", soft_wrap=True, markup=False, highlight=False)
        told = set(now)
        parts = [f"{name} {_states(one)} {_outputs(one)}".strip() for name, one in session.sessions.items()]
        stderr.print(f"{session.elapsed_s:6.0f} s  {' | '.join(parts)}", soft_wrap=True, markup=False, highlight=False)


def _table(session: NetworkSession) -> Group:
    table = Table(expand=False, pad_edge=False, box=None, header_style="dim")
    for column, right in (
        ("system", 0), ("state", 0), ("outputs", 0), ("devices", 0), ("sent", 1), ("received", 1), ("lost", 1)
    ):  # fmt: skip
        table.add_column(column, justify="right" if right else "left", no_wrap=True)
    counters = session.counters()
    for name in session.network.places:
        one, sea = session.sessions.get(name), counters[name]
        lost = sum(sea[why] for why in ("collision", "speaking", "chance", "fault"))
        row = [name, "", "", ""] if one is None else [name, _states(one), _outputs(one), _devices(one)]
        table.add_row(*row, str(sea["said"]), str(sea["heard"]), str(lost))
    head = Text(f"{session.network.name}, {session.elapsed_s:.0f} s")
    lines = [Text(f"! {trouble}", style="red") for trouble in _troubles(session)[-MAX_TROUBLES:]]
    return Group(head, table, *lines)


def _states(session: RunSession) -> str:
    return " ".join(session.states.current.values())


def _outputs(session: RunSession) -> str:
    """Return the output values that the control logic commands, as text ``NAME VALUE``."""
    outputs = session.gateway_status.outputs if session.gateway_status is not None else []
    return " ".join(f"{o.tag.partition('.')[2]} {o.wanted:g}" for o in outputs if o.wanted is not None)


def _devices(session: RunSession) -> str:
    devices = session.gateway_status.devices if session.gateway_status is not None else {}
    bad = [name for name, device in devices.items() if not device.online]
    return f"{', '.join(bad)} bad" if bad else f"{len(devices)} good" if devices else ""


def _troubles(session: NetworkSession) -> list[str]:
    return [f"{name}: {text}" for name, one in session.sessions.items() for text in troubles(one)]


# -- at the end ---------------------------------------------------------------------------------------------------------


def print_network_summary(summary: dict[str, Any]) -> None:
    """Print the summary of a network run on stdout, with the verdict."""
    stdout.print(f"[bold]{summary['network']}[/bold] (network of prototypes), {summary['duration_s']:.1f} s")
    for name, one in summary["systems"].items():
        good = [device for device, d in one["devices"].items() if d["state"] == "good"]
        devices = f"{', '.join(good)} [green]good[/green]" if good else ""
        bad = [f"{device} [red]bad[/red] {d['error']}" for device, d in one["devices"].items() if device not in good]
        stdout.print(
            f"  {name:<14} {'; '.join([*([devices] if devices else []), *bad])}", soft_wrap=True, highlight=False
        )
        for states in one["states"].values():
            stdout.print(f"  {'':<14} {' → '.join(states) or 'no scan observed'}", soft_wrap=True, highlight=False)
        published = one["published"]
        stdout.print(
            f"  {'':<14} published {published['checked']} compared with what the devices held, {published['wrong']} wrong;"
            f" logged {one['logged']}",
            soft_wrap=True,
            highlight=False,
        )
        print_faults(one["faults"])
        for error in one["errors"]:
            stdout.print(f"  {'':<14} [red]error[/red] {error}", soft_wrap=True, highlight=False)
    for name, sea in summary["water"].items():
        lost = ", ".join(f"{sea[why]} by {why}" for why in ("chance", "collision", "speaking", "fault") if sea[why])
        text = f"sent {sea['said']}, received {sea['heard']}" + (f"; missed {lost}" if lost else "")
        stdout.print(
            f"  {'water' if name == next(iter(summary['water'])) else '':<14} {name}: {text}",
            soft_wrap=True,
            highlight=False,
        )
    print_faults(summary["faults"])
    if ship := summary["ship"]:
        stdout.print(f"  {SHIP:<14} commands {ship['commands_sent']}, heard {ship['responses']}", highlight=False)
    for error in summary["errors"]:
        stdout.print(f"  [red]error[/red]          {error}", soft_wrap=True)
    stdout.print("[bold green]ok[/bold green]" if summary["ok"] else "[bold red]not ok[/bold red]")
