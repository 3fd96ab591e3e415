"""`fieldtwin can-bus`: the software CAN bus on its own."""

from __future__ import annotations

import asyncio
import signal

import click

from emulators.endpoints.bus_server import SoftBusServer
from fieldtwin.cli.talk import talk
from gateway.core.endpoint import Endpoint


@click.command("can-bus")
@click.option(
    "--listen",
    default="127.0.0.1:29536",
    show_default=True,
    metavar="HOST:PORT",
    help="Where nodes join; port 0 takes a free one.",
)
@click.option("--bitrate", type=click.IntRange(10_000, 1_000_000), default=125_000, show_default=True, help="bit/s")
@click.option("--unpaced", is_flag=True, help="Deliver frames at once instead of at the bit rate.")
def command(listen: str, bitrate: int, unpaced: bool) -> int:
    """Run a CAN bus where the kernel has none.

    Frames take their exact time on the modelled bus and arbitrate by identifier. Any python-can program joins with
    interface `fieldtwin` and channel HOST:PORT, for example `python -m can.logger -i fieldtwin -c 127.0.0.1:29536`.
    """
    return asyncio.run(_run(Endpoint.parse(f"can:fieldtwin/{listen}"), bitrate, paced=not unpaced))


async def _run(endpoint: Endpoint, bitrate: int, *, paced: bool) -> int:
    stop = asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, stop.set)
    bus = await SoftBusServer.open(endpoint, bitrate, paced=paced)
    try:
        talk.print(f"CAN bus on {bus.bound}, {bitrate} bit/s", soft_wrap=True)
        await stop.wait()
        stats = bus.bus_stats()
        talk.print(f"{stats['frames']} frames, load {100 * stats['load']:.1f} %")
    finally:
        await bus.aclose()
    return 0
