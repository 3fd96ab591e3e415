"""Scan a CAN bus at this computer for nodes: the public interface of the CANopen master's node scan. The scan only reads."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from fieldtwin.gateway.connections.os_connector import OsConnector
from fieldtwin.gateway.core.clock import Clock
from fieldtwin.gateway.core.concurrency.nursery import Nursery
from fieldtwin.gateway.core.connection import Connector
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.gateway.protocols.canopen.cob_id import NODE_MAX
from fieldtwin.gateway.protocols.canopen.master import CanopenMaster
from fieldtwin.gateway.protocols.canopen.scan import FoundNode, scan_nodes
from fieldtwin.gateway.wallclock import WallClock


async def scan_can_bus(
    url: str,
    bitrate: int = 0,
    *,
    nodes: Iterable[int] = range(1, NODE_MAX + 1),
    listen_s: float = 2.0,
    on_progress: Callable[[int], None] | None = None,
    connector: Connector | None = None,
    clock: Clock | None = None,
) -> tuple[FoundNode, ...]:
    """Return the nodes on the bus at `url` by node ID: state, identity, and whether they answer SDO requests.

    `url` is ``can:socketcan/can0`` or ``can:fieldtwin/HOST:PORT``. The function joins the bus at `bitrate` bit/s (0: the present
    rate of the bus, if the adapter or simulated bus knows it), listens for `listen_s` seconds, then queries each of `nodes` at a
    limited rate: 17 s for all of them. `on_progress` is called with each node ID before its query. Raises `UsageError` for a URL
    that is not a CAN bus, and `Unreachable` or `ConnectionLost` if the bus cannot be reached.
    """
    endpoint = Endpoint.parse(url)
    if not endpoint.is_can:
        raise UsageError("nodes are on a CAN bus", expected="can:socketcan/can0 or can:fieldtwin/HOST:PORT", got=url)
    clock = clock or WallClock()
    connection = await (connector or OsConnector()).open_can(endpoint, bitrate)
    try:
        master = CanopenMaster(connection, clock)
        async with Nursery() as nursery:
            nursery.start(master.run(), "master of the scan")
            return await scan_nodes(master, clock, nodes=nodes, listen_s=listen_s, on_progress=on_progress)
    finally:
        await connection.aclose()
