"""`fieldtwin link`: the emulated connection as a separate process, compatible with socat."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from contextlib import AsyncExitStack
from functools import partial
from pathlib import Path
from typing import Any

import click

from fieldtwin.console import stderr
from fieldtwin.emulators.can_link import CanLink
from fieldtwin.emulators.endpoints.can.bus_server import SoftBusServer
from fieldtwin.emulators.endpoints.can.software_end import open_can_end
from fieldtwin.emulators.faults.engine import WireFaults
from fieldtwin.emulators.faults.frames import FrameDirection, Framing
from fieldtwin.emulators.faults.on_link import check_can_link, check_link, wire_faults
from fieldtwin.emulators.faults.schema import FaultSpec, load_faults
from fieldtwin.emulators.link import run_link
from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.concurrency.stop_signal import stop_signal
from fieldtwin.gateway.core.connection import CanConnection
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.run.emulate.fault_counts import effect_text

BITRATE = 125_000
"""Bit rate of a software CAN bus that the link itself runs, if its endpoint has no ``bitrate=``."""


@click.command("link")
@click.argument("near")
@click.argument("far")
@click.option(
    "--faults",
    "faults_file",
    type=click.Path(exists=True, dir_okay=False),
    help="Inject these faults (see fieldtwin faults).",
)
@click.option(
    "--framing",
    type=click.Choice([framing.value for framing in Framing]),
    default="rtu",
    help="With --faults: framing of the link; default: rtu.",
)
@click.option("--seed", type=int, default=1, help="With --faults: seed of random choices; default: 1.")
def command(near: str, far: str, faults_file: str | None, framing: str, seed: int) -> int:
    """Carry a serial line over TCP: a port at NEAR, its line at FAR. With --faults, connect any two sockets, serial lines or
    CAN buses, and inject faults between them.

    NEAR and FAR are endpoints; a plain path is a new virtual serial port. The link interoperates with `socat
    pty,raw,echo=0,link=PATH tcp:HOST:PORT` on either side.

    \b
    A virtual port here, the device's line there:
      fieldtwin link /tmp/line1 tcp://field:4001
    A real port, offered to other computers:
      fieldtwin link rtu:/dev/ttyUSB0 "tcp://0.0.0.0:4001?listen=1"
    With faults, over TCP or between two programs with serial ports:
      fieldtwin link --faults noisy.yaml /tmp/line1 tcp://plc:4001
      fieldtwin link --faults noisy.yaml /tmp/client /tmp/device
    Two CAN buses, with the NMT master on the first:
      fieldtwin link --faults lost.yaml \\
          "can:fieldtwin/127.0.0.1:29540?listen=1" can:socketcan/can0
    MQTT clients and a broker:
      fieldtwin link --faults bad.yaml --framing mqtt \\
          "tcp://127.0.0.1:1884?listen=1" tcp://broker:1883
    """
    ends = _endpoint(near), _endpoint(far)
    on_can = any(end.is_can for end in ends)
    if on_can and not (all(end.is_can for end in ends) and faults_file):
        raise UsageError(f"{near} and {far}: a CAN link needs two CAN buses and --faults", expected="--faults FILE")
    frames = Framing.RAW if on_can else Framing(framing)
    check = check_can_link if on_can else partial(check_link, framing=frames)
    said = load_faults(Path(faults_file), check) if faults_file else ()
    return asyncio.run(_run(*ends, said, frames, seed, check))


def _endpoint(text: str) -> Endpoint:
    if "/" in text and ":" not in text:
        if Path(text).is_char_device() and not Path(text).is_symlink():
            raise UsageError(f"{text} is a real port", expected=f"rtu:{text}")
        return Endpoint("pty", path=text)
    return Endpoint.parse(text)


async def _run(
    near: Endpoint,
    far: Endpoint,
    said: tuple[dict[str, Any], ...],
    framing: Framing,
    seed: int,
    check: Callable[[FaultSpec], None],
) -> int:
    loop = asyncio.get_running_loop()
    faults = wire_faults(said, framing, seed, round(loop.time() * NS_PER_S), check) if said else None
    put_in = tuple(faults.active.values()) if faults is not None else ()
    stop = stop_signal()
    linking = asyncio.create_task(_can(near, far, faults) if near.is_can and faults else _bytes(near, far, faults))
    stopping = asyncio.create_task(stop.wait())
    try:
        await asyncio.wait([linking, stopping], return_when=asyncio.FIRST_COMPLETED)
        if linking.done():
            linking.result()
    finally:
        for task in (linking, stopping):
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)
        for active in put_in:
            stderr.print(effect_text(active), soft_wrap=True, markup=False)
    return 0


async def _bytes(near: Endpoint, far: Endpoint, faults: WireFaults | None) -> None:
    await run_link(
        near,
        far,
        on_event=lambda text: stderr.print(text, soft_wrap=True, markup=False),
        on_ready=lambda link: stderr.print(f"{near}  ⇄  {far}", soft_wrap=True, markup=False),
        faults=faults,
    )


async def _can(near: Endpoint, far: Endpoint, faults: WireFaults) -> None:
    async with AsyncExitStack() as closing:
        link = CanLink(await _can_end(near, closing), await _can_end(far, closing), faults)
        closing.push_async_callback(link.aclose)
        link.start()
        stderr.print(f"{near}  ⇄  {far}", soft_wrap=True, markup=False)
        try:
            raise await asyncio.shield(link.ended)
        finally:
            to, back = link.passed[FrameDirection.REQUEST], link.passed[FrameDirection.REPLY]
            stderr.print(f"{to} frames to {far}, {back} back, {link.lost} lost", soft_wrap=True, markup=False)


async def _can_end(endpoint: Endpoint, closing: AsyncExitStack) -> CanConnection:
    """Join a CAN bus; with ``?listen=1`` run a bus that other programs join."""
    if endpoint.param("listen") not in ("1", "true"):
        end = await open_can_end(endpoint, 0)
        closing.push_async_callback(end.aclose)
        return end
    bus = await SoftBusServer.open(endpoint, int(endpoint.param("bitrate") or BITRATE), paced=True)
    closing.push_async_callback(bus.aclose)
    return bus.attach("link")
