"""`fieldtwin twin`: a shadow with a way back: it plans, asks its model, and commands the plant."""

from __future__ import annotations

import asyncio
import json
import signal
import sys
from pathlib import Path
from typing import Any

import click

from fieldtwin.cli.options import Duration, json_option, profiles_option
from fieldtwin.cli.shadow_command import ShadowTalk, print_shadow
from fieldtwin.cli.talk import talk
from fieldtwin.running.twin_rules import load_planner
from fieldtwin.running.twinning import Twinning
from gateway.core.errors import Unreachable
from gateway.core.statemachine import decode_period, encode_period
from gateway.core.values import COMMAND
from twin.instance import Instance
from twin.mape.plan import RulePlanner
from twin.system import System, load_system


@click.command("twin")
@click.argument("system")
@click.option(
    "--from", "place", required=True, metavar="URL", help="Where the plant's thread is, as of `fieldtwin shadow`."
)
@click.option("--plan", "planner", default="", metavar="FILE", help='Rules (YAML), or "python: module:Class".')
@click.option("--command", "periods", multiple=True, type=int, metavar="SECONDS", help="A period to plan at the start.")
@click.option(
    "--store", default="", metavar="FILE|URL", help="What keeps the knowledge; default: in the run directory."
)
@click.option(
    "--for", "duration_s", type=Duration(), default=0.0, help="Stop after a time such as 20s; default: run on."
)
@click.option("--instance", default="", help="Name of the run directory; default: the system's name and -twin.")
@profiles_option
@json_option
def command(
    system: str,
    place: str,
    planner: str,
    periods: tuple[int, ...],
    store: str,
    duration_s: float,
    instance: str,
    profiles: tuple[str, ...],
    as_json: bool,
) -> int:
    """Twin SYSTEM: as `fieldtwin shadow`, and command the plant by rules over what is found.

    Each command is held against the digital model and the limits in the system file first; only what they accept is sent.
    The plant obeys while its own switch says `remote`, inside the limits and the rate in its own file, and no number twice.
    """
    loaded = load_system(system, tuple(Path(p) for p in profiles))
    chosen = load_planner(planner, loaded) if planner else RulePlanner(())
    with Instance(instance or f"{loaded.name}-twin") as here:
        plans = [encode_period(period) for period in periods]
        talks = ShadowTalk(quiet=as_json)

        def sent(command: COMMAND) -> None:
            if not as_json:
                talk.print(f"             command    period {decode_period(command)} s")

        twinning = Twinning(loaded, place, here, store=store, on_verdict=talks, on_command=sent, planner=chosen)
        for plan in plans:
            twinning.plan(plan)
        seen = asyncio.run(_run(loaded, place, twinning, duration_s, as_json))
    if as_json:
        json.dump(seen, sys.stdout, indent=2)
        sys.stdout.write("\n")
    else:
        print_shadow(seen)
        talk.print(f"  commands   {seen['planned']} planned, {seen['sent']} sent, {seen['refused']} refused")
    if not seen["origins"]:
        raise Unreachable(f"the plant's thread: {seen['thread'].get('trouble') or 'nothing came'}", where=place)
    return 0 if seen["agreed"] == seen["statuses"] else 1


async def _run(system: System, place: str, twinning: Twinning, duration_s: float, as_json: bool) -> dict[str, Any]:
    stop = asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, stop.set)
    if not as_json:
        talk.print(f"[bold]twin[/bold] of {system.name}, opposite {place}", soft_wrap=True, markup=True)
    await twinning.run(stop, duration_s)
    return twinning.describe()
