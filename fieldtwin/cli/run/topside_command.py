"""`fieldtwin topside`: the topside controller of a system's modem, as a separate process."""

from __future__ import annotations

import asyncio
import json
import sys
from pathlib import Path

import click

from fieldtwin.cli.options import Duration, Secret, json_option, profiles_option
from fieldtwin.console import stderr
from fieldtwin.gateway.core.concurrency.stop_signal import stop_signal
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.gateway.wallclock import WallClock
from fieldtwin.run.processes.field_contact import connect_control, reachable
from fieldtwin.run.processes.topside import TopsideController, parse_periods, script
from fieldtwin.twin.prototype.field_status import FieldStatus
from fieldtwin.twin.site.system import System, load_system


@click.command("topside")
@click.argument("system")
@click.option(
    "--far", default="", metavar="ENDPOINT", help="Endpoint of the topside modem, such as tcp://modem-ashore:502."
)
@click.option(
    "--field",
    "field_host",
    default="",
    metavar="HOST[:PORT]",
    help="Alternatively: ask this field simulator for the endpoint of its topside modem.",
)
@click.option(
    "--token",
    type=Secret(),
    default="",
    metavar="@FILE",
    help="Token of that simulator's control channel; or FIELDTWIN_TOPSIDE_TOKEN.",
)
@click.option("--device", default="", help="The transmitter device; default: the system's only one.")
@click.option(
    "--commands", default="none", metavar="1,2,0,-1", help="Sample periods to command, spread over the run; or none."
)
@click.option(
    "--for",
    "duration_s",
    type=Duration(),
    default=0.0,
    help="Stop after a time such as 20s; default: run until Ctrl-C.",
)
@profiles_option
@json_option
def command(
    system: str,
    far: str,
    field_host: str,
    token: str,
    device: str,
    commands: str,
    duration_s: float,
    profiles: tuple[Path, ...],
    as_json: bool,
) -> int:
    """Send commands to SYSTEM from the topside end of its modem, and show the responses."""
    loaded = load_system(system, profiles)
    transmitter = _transmitter(loaded, device)
    if bool(far) == bool(field_host):
        raise UsageError("the endpoint of the topside modem is missing", expected="--far ENDPOINT or --field HOST")
    periods = parse_periods(commands)
    return asyncio.run(_run(loaded, transmitter, far, field_host, token, periods, duration_s, as_json))


def _transmitter(system: System, name: str) -> str:
    transmitters = [d.name for d in system.devices.values() if d.profile.inbox is not None]
    if not transmitters:
        raise UsageError(
            f"{system.name} has no acoustic modem, so it has no topside controller",
            where=str(system.path),
            expected="a system with a device whose profile has an `inbox`, such as the profile modem-mailbox",
            hint="an HMI or SCADA reads and commands other systems through `serve:` in the system file",
        )
    if name and name not in transmitters:
        raise UsageError(f"{name!r} is not a transmitter", expected=", ".join(transmitters))
    if not name and len(transmitters) != 1:
        raise UsageError("which transmitter?", expected="--device with one of " + ", ".join(transmitters))
    return name or transmitters[0]


async def _run(
    system: System,
    device: str,
    far: str,
    field_host: str,
    token: str,
    periods: tuple[int, ...],
    duration_s: float,
    as_json: bool,
) -> int:
    stop = stop_signal()
    endpoint = Endpoint.parse(far) if far else await _ask_field(device, field_host, token)
    topside = TopsideController(system, device, endpoint, WallClock())
    stderr.print(f"topside end of {device} at {endpoint}", soft_wrap=True)
    serving = asyncio.create_task(topside.run(script(periods, duration_s or 20.0)))
    showing = asyncio.create_task(_show(topside)) if not as_json else None
    stopping = asyncio.create_task(stop.wait())
    try:
        await asyncio.wait([serving, stopping], timeout=duration_s or None, return_when=asyncio.FIRST_COMPLETED)
    finally:
        for task in (stopping, showing, serving):
            if task is not None:
                task.cancel()
                await asyncio.gather(task, return_exceptions=True)
    seen = topside.describe()
    if as_json:
        json.dump(seen, sys.stdout)
        sys.stdout.write("\n")
    else:
        stderr.print(f"commands {seen['commands_sent']}, responses {seen['responses']}")
    return 0 if seen["responses"] or not periods else 1


async def _ask_field(device: str, field_host: str, token: str) -> Endpoint:
    client, host = await connect_control(field_host, token)
    try:
        far = (await client.ask("get", FieldStatus)).far
    finally:
        await client.aclose()
    if device not in far:
        raise UsageError(f"that field simulator has no topside end of {device!r}", expected=", ".join(far) or "none")
    return reachable(Endpoint.parse(far[device]), host)


async def _show(topside: TopsideController) -> None:
    shown = 0
    while True:
        await asyncio.sleep(0.2)
        new = topside.responses_received - shown
        for response in list(topside.responses)[-new:] if new else []:
            stderr.print(f"response {response.hex()}", soft_wrap=True)
        shown = topside.responses_received
