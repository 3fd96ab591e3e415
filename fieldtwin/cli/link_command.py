"""`fieldtwin link`: the emulated connection on its own, socat-compatible."""

from __future__ import annotations

import asyncio
import signal
from pathlib import Path

import click

from emulators.link import run_link
from fieldtwin.cli.talk import talk
from gateway.core.endpoint import Endpoint
from gateway.core.errors import UsageError


@click.command("link")
@click.argument("near")
@click.argument("far")
def command(near: str, far: str) -> int:
    """Carry a serial line over TCP, byte for byte: a port at NEAR, its line at FAR.

    NEAR and FAR are endpoints; a plain path is a virtual serial port that is made there. Interoperates with
    `socat pty,raw,echo=0,link=PATH tcp:HOST:PORT` on either side.

    \b
    fieldtwin link /tmp/line1 tcp://field:4001            a port here, the device's line there
    fieldtwin link rtu:/dev/ttyUSB0 "tcp://0.0.0.0:4001?listen=1"    a real port, offered to others
    """
    ends = [_endpoint(near), _endpoint(far)]
    return asyncio.run(_run(*ends))


def _endpoint(text: str) -> Endpoint:
    if "/" in text and ":" not in text:
        if Path(text).is_char_device() and not Path(text).is_symlink():
            raise UsageError(f"{text} is a real port", expected=f"rtu:{text}")
        return Endpoint("pty", path=text)
    return Endpoint.parse(text)


async def _run(near: Endpoint, far: Endpoint) -> int:
    loop = asyncio.get_running_loop()
    stop = asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, stop.set)
    linking = asyncio.create_task(
        run_link(
            near,
            far,
            on_event=lambda text: talk.print(text, soft_wrap=True, markup=False),
            on_ready=lambda link: talk.print(f"{near}  ⇄  {far}", soft_wrap=True, markup=False),
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
