"""Serve emulated devices in this terminal until a signal or a failure ends it."""

from __future__ import annotations

import asyncio

from fieldtwin.emulators.host import EmulatorHost
from fieldtwin.gateway.core.concurrency.nursery import Nursery


async def serve_until(stop: asyncio.Event, host: EmulatorHost) -> None:
    """Serve until `stop` is set, then close the host. Raises the failure of a server at once."""
    async with Nursery() as nursery:
        serving = nursery.start(host.run(), "emulators")
        stopping = nursery.start(stop.wait(), "until stopped")
        await asyncio.wait([serving, stopping], return_when=asyncio.FIRST_COMPLETED)
        if serving.done():
            serving.result()
