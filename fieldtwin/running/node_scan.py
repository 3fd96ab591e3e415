"""Who is on a CAN bus of this computer: the public door to the CANopen master's node scan. It only reads."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from fieldtwin.gateway.connections.os_connector import OsConnector
from fieldtwin.gateway.core.clock import Clock
from fieldtwin.gateway.core.connection import Connector
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.gateway.core.nursery import Nursery
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
    """The nodes on the bus at `url` (``can:socketcan/can0``, ``can:fieldtwin/HOST:PORT``), by node id: state, identity, and
    whether it answers SDOs.

    Joins the bus at `bitrate` bit/s (0: whatever it runs at, where the medium knows), listens for `listen_s`, then asks
    each of `nodes`, paced: 17 s for all of them. `on_progress` is told each node id before it is asked. Raises `UsageError`
    for a url that is no CAN bus, and `Unreachable` or `ConnectionLost` where there is none.
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
