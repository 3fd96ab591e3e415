"""`fieldtwin link`: the emulated connection on its own, socat-compatible."""

from __future__ import annotations

import asyncio
import signal
from pathlib import Path
from typing import Any

import click

from emulators.faults.frames import Framing
from emulators.faults.on_link import check_link, wire_faults
from emulators.faults.schema import load_faults
from emulators.link import run_link
from fieldtwin.cli.talk import talk
from gateway.core.clock import NS_PER_S
from gateway.core.endpoint import Endpoint
from gateway.core.errors import UsageError


@click.command("link")
@click.argument("near")
@click.argument("far")
@click.option(
    "--faults",
    "faults_file",
    type=click.Path(exists=True, dir_okay=False),
    help="Put these faults on it (fieldtwin faults).",
)
@click.option(
    "--framing",
    type=click.Choice([framing.value for framing in Framing]),
    default="rtu",
    help="With --faults: how frames look on it; default: rtu.",
)
@click.option("--seed", type=int, default=1, help="With --faults: of what is left to chance; default: 1.")
def command(near: str, far: str, faults_file: str | None, framing: str, seed: int) -> int:
    """Carry a serial line over TCP, byte for byte: a port at NEAR, its line at FAR.

    NEAR and FAR are endpoints; a plain path is a virtual serial port that is made there. Interoperates with
    `socat pty,raw,echo=0,link=PATH tcp:HOST:PORT` on either side.

    \b
    fieldtwin link /tmp/line1 tcp://field:4001            a port here, the device's line there
    fieldtwin link rtu:/dev/ttyUSB0 "tcp://0.0.0.0:4001?listen=1"    a real port, offered to others
    fieldtwin link --faults noisy.yaml /tmp/line1 tcp://plc:4001     the same, with what goes wrong on lines
    fieldtwin link --faults bad.yaml --framing mqtt "tcp://127.0.0.1:1884?listen=1" tcp://broker:1883      a bad way to a broker
    """
    ends = _endpoint(near), _endpoint(far)
    faults = load_faults(Path(faults_file), check_link) if faults_file else ()
    return asyncio.run(_run(*ends, faults, Framing(framing), seed))


def _endpoint(text: str) -> Endpoint:
    if "/" in text and ":" not in text:
        if Path(text).is_char_device() and not Path(text).is_symlink():
            raise UsageError(f"{text} is a real port", expected=f"rtu:{text}")
        return Endpoint("pty", path=text)
    return Endpoint.parse(text)


async def _run(near: Endpoint, far: Endpoint, faults: tuple[dict[str, Any], ...], framing: Framing, seed: int) -> int:
    loop = asyncio.get_running_loop()
    on_it = wire_faults(faults, framing, seed, round(loop.time() * NS_PER_S)) if faults else None
    stop = asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, stop.set)
    linking = asyncio.create_task(
        run_link(
            near,
            far,
            on_event=lambda text: talk.print(text, soft_wrap=True, markup=False),
            on_ready=lambda link: talk.print(f"{near}  ⇄  {far}", soft_wrap=True, markup=False),
            faults=on_it,
        )
    )
    stopping = asyncio.create_task(stop.wait())
    try:
        await asyncio.wait([linking, stopping], return_when=asyncio.FIRST_COMPLETED)
        if linking.done():
            linking.result()
    finally:
        for task in (linking, stopping):
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)
    return 0
