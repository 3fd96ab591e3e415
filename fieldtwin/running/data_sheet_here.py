"""A CANopen node from nothing but its data sheet: what `fieldtwin emulate FILE.eds --on can:...` runs."""

from __future__ import annotations

import asyncio
import signal
from pathlib import Path

from emulators.canopen.dictionary import Dictionary, load_eds
from emulators.canopen.lss import UNCONFIGURED
from emulators.canopen.node import CanopenNode, NodeContext
from emulators.canopen.serve import serve_node
from emulators.endpoints.bus_server import SoftBusServer
from emulators.endpoints.can_end import open_can_end
from emulators.models.by_profile import model_for
from fieldtwin.cli.talk import talk
from gateway.core.connection import CanConnection
from gateway.core.endpoint import Endpoint
from gateway.core.errors import UsageError
from gateway.core.nursery import Nursery
from gateway.wallclock import WallClock

DEFAULT_BIT_RATE = 125_000
DEFAULT_NODE_ID = 1


async def run_data_sheet(path: Path, endpoints: tuple[str, ...], node_id: int | None) -> int:
    """Serve until SIGINT or SIGTERM. What was mended in the file is said first.

    The node id is `node_id`, else what a DCF commissions, else 1; the bit rate of a bus that is made here that of the DCF, else
    125 kbit/s. Raises `FileInvalid` for a file that cannot be used, `UsageError` for endpoints that are not one bus.
    """
    dictionary = load_eds(path)
    for note in dictionary.notes:
        talk.print(f"{path.name}, {note}", soft_wrap=True)
    wires = [Endpoint.parse(url) for url in endpoints]
    if len(wires) != 1 or not wires[0].is_can:
        raise UsageError(
            "a CANopen node stands on one bus", expected="--on can:fieldtwin/127.0.0.1:0 or can:socketcan/vcan0"
        )
    node = _node(dictionary, node_id or dictionary.node_id or DEFAULT_NODE_ID)
    stop = asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, stop.set)
    closing: list[SoftBusServer | CanConnection] = []
    async with Nursery() as nursery:
        try:
            connection, where = await _open(wires[0], dictionary.bit_rate or DEFAULT_BIT_RATE, path.stem, closing)
            nursery.start(serve_node(connection, node, WallClock()), f"node on {where}")
            talk.print(f"{_named(node)} on {where}", soft_wrap=True)
            await asyncio.wait([nursery.start(stop.wait(), "until stopped")])
        finally:
            for thing in reversed(closing):
                await thing.aclose()
    return 0


def _node(dictionary: Dictionary, node_id: int) -> CanopenNode:
    """With the model of the device profile that 1000h names, where there is one."""
    return CanopenNode(dictionary, node_id, NodeContext(model=model_for(dictionary)))


def _named(node: CanopenNode) -> str:
    return "node without an id" if node.node_id == UNCONFIGURED else f"node {node.node_id}"


async def _open(
    wire: Endpoint, bit_rate: int, name: str, closing: list[SoftBusServer | CanConnection]
) -> tuple[CanConnection, Endpoint]:
    if wire.interface == "fieldtwin":
        bus = await SoftBusServer.open(wire, bit_rate)
        closing.append(bus)
        connection, where = bus.attach(name), bus.bound
    else:
        connection, where = await open_can_end(wire, bit_rate), wire
    closing.append(connection)
    return connection, where
