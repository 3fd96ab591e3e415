"""`fieldtwin can-bus`: run the software CAN bus as a separate process."""

from __future__ import annotations

import asyncio
from contextlib import AsyncExitStack
from typing import Any

import click

from fieldtwin.console import stderr
from fieldtwin.emulators.endpoints.can.bus_bridge import CanBridge
from fieldtwin.emulators.endpoints.can.bus_server import SoftBusServer
from fieldtwin.emulators.endpoints.can.slcan_port import SlcanPort
from fieldtwin.emulators.endpoints.can.software_end import open_can_end
from fieldtwin.gateway.core.concurrency.stop_signal import stop_signal
from fieldtwin.gateway.core.endpoint import Endpoint


@click.command("can-bus")
@click.option(
    "--listen",
    default="127.0.0.1:29536",
    show_default=True,
    metavar="HOST:PORT",
    help="Where nodes join; port 0 selects a free port.",
)
@click.option("--bitrate", type=click.IntRange(10_000, 1_000_000), default=125_000, show_default=True, help="bit/s")
@click.option(
    "--data-bitrate",
    type=click.IntRange(10_000, 8_000_000),
    help="bit/s of the data phase of CAN FD frames with the bit-rate switch; default: as --bitrate.",
)
@click.option("--unpaced", is_flag=True, help="Deliver frames at once instead of at the bit rate.")
@click.option("--slcan", metavar="HOST:PORT", help="A second port for programs that use slcan (LAWICEL).")
@click.option(
    "--bridge", metavar="IFACE", help="Kernel interface, such as vcan0, to bridge with the bus in both directions."
)
@click.option(
    "--strict-ack", is_flag=True, help="Require an acknowledging node: a node that is alone becomes error-passive."
)
def command(
    listen: str,
    bitrate: int,
    data_bitrate: int | None,
    unpaced: bool,
    slcan: str | None,
    bridge: str | None,
    strict_ack: bool,
) -> int:
    """Run a software CAN bus, for hosts without a CAN interface.

    Frames take their exact time on the modelled bus and arbitrate by identifier. A python-can program joins with interface
    `fieldtwin` and channel HOST:PORT, for example `python -m can.logger -i fieldtwin -c 127.0.0.1:29536`. With `--slcan
    HOST:PORT` other programs can join, for example `python -m can.logger -i slcan -c socket://HOST:PORT`.
    """
    endpoint = Endpoint.parse(f"can:fieldtwin/{listen}")
    ascii_port = Endpoint.parse(f"tcp://{slcan}") if slcan else None
    kernel = Endpoint.parse(f"can:socketcan/{bridge}") if bridge else None
    rates = (bitrate, data_bitrate or 0)
    return asyncio.run(_run(endpoint, rates, ascii_port, kernel, paced=not unpaced, monitored=not strict_ack))


async def _run(
    endpoint: Endpoint,
    rates: tuple[int, int],
    slcan: Endpoint | None,
    kernel: Endpoint | None,
    *,
    paced: bool,
    monitored: bool,
) -> int:
    stop, (bitrate, data_bitrate) = stop_signal(), rates
    async with AsyncExitStack() as closing:
        bus = await SoftBusServer.open(endpoint, bitrate, paced=paced, monitored=monitored, data_bitrate=data_bitrate)
        closing.push_async_callback(bus.aclose)
        bridge = await _bridge(bus, kernel, bitrate) if kernel else None
        if bridge:
            closing.push_async_callback(bridge.aclose)
        stderr.print(f"CAN bus on {bus.bound}, {bitrate} bit/s", soft_wrap=True)
        if slcan:
            port = await SlcanPort.open(bus.runner, slcan)
            closing.push_async_callback(port.aclose)
            stderr.print("slcan on {}:{}".format(*port.bound), soft_wrap=True)
        await _until(stop, bridge)
        stats = bus.bus_stats()
        stderr.print(f"{stats['frames']} frames, load {100 * stats['load']:.1f} %, {stats['error_frames']} errors")
        if bridge:
            crossed = ", ".join(f"{count} from {where}" for where, count in bridge.forwarded.items())
            stderr.print(f"bridge: {crossed}; {bridge.lost} lost", soft_wrap=True)
            if bridge.ended.done():
                raise bridge.ended.result()
    return 0


async def _bridge(bus: SoftBusServer, kernel: Endpoint, bitrate: int) -> CanBridge:
    outside = await open_can_end(kernel, bitrate)
    bridge = CanBridge(bus.attach(f"bridge to {kernel.path}"), outside)
    bridge.start()
    stderr.print(f"joined with {kernel}", soft_wrap=True)
    return bridge


async def _until(stop: asyncio.Event, bridge: CanBridge | None) -> None:
    """Wait until the user stops the command, or a bus of the bridge is lost."""
    stopped = asyncio.ensure_future(stop.wait())
    waited: list[asyncio.Future[Any]] = [stopped, bridge.ended] if bridge else [stopped]
    await asyncio.wait(waited, return_when=asyncio.FIRST_COMPLETED)
    stopped.cancel()
