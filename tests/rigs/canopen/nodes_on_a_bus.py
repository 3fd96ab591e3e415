"""CANopen nodes on a bus in memory and in virtual time, for the checks of nodes: ours, and the `canopen` package's LocalNode."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import TypeVar

from canopen_localnode import LocalNodeOnBus
from canopen_slave_rig import NODE, RICH

from fieldtwin.emulators.canopen.eds.dictionary import parse_eds
from fieldtwin.emulators.canopen.node import CanopenNode
from fieldtwin.emulators.canopen.serve import serve_node
from fieldtwin.emulators.endpoints.memory_ports import MemoryNet
from fieldtwin.emulators.virtual.clock import VirtualClock
from fieldtwin.emulators.virtual.loop import VirtualLoop
from fieldtwin.gateway.core.concurrency.nursery import Nursery
from fieldtwin.gateway.core.connection import CanConnection
from fieldtwin.gateway.core.endpoint import Endpoint

T = TypeVar("T")
LONG = RICH.replace("DefaultValue=hello", "DefaultValue=twenty bytes of text")
"""2004h takes three segments."""
Serve = Callable[[CanConnection, VirtualClock], Awaitable[None]]


async def ours(connection: CanConnection, clock: VirtualClock) -> None:
    """The node with every kind of object."""
    await serve_node(connection, CanopenNode(parse_eds(LONG), NODE), clock)


async def local_node(connection: CanConnection, clock: VirtualClock) -> None:
    """The same data sheet, served by the `canopen` package."""
    await LocalNodeOnBus(connection, LONG).serve()


def on_bus(serve: Serve, use: Callable[[MemoryNet, str, VirtualClock], Awaitable[T]]) -> T:
    """Return the result of `use` with a node on a bus of 125 kbit/s. `use` gets the net, the bus's URL and the clock."""
    loop = VirtualLoop()

    async def main() -> T:
        net, clock = MemoryNet(loop), VirtualClock(loop)
        bus = await net.can_bus(Endpoint.parse("can:fieldtwin/127.0.0.1:0"), 125_000, paced=True)
        try:
            async with Nursery() as nursery:
                nursery.start(serve(await bus.join("node"), clock), "node")
                return await use(net, str(bus.bound), clock)
        finally:
            await bus.aclose()

    with asyncio.Runner(loop_factory=lambda: loop) as runner:
        return runner.run(main())
