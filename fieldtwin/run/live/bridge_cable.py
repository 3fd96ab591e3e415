"""The serial line of a simulated bridge: two virtual serial ports joined by a cable.

On a plant, a Modbus client is connected to the line on which a bridge listens. In a simulation (prototype) the gateway
opens one end here, and the test or program that acts as that client opens the other. The cable belongs to neither side
and must not depend on the protocol that is spoken over it.
"""

from __future__ import annotations

from pathlib import Path

from fieldtwin.emulators.endpoints.pty import PtyEnd
from fieldtwin.gateway.core.concurrency.nursery import Nursery
from fieldtwin.gateway.core.connection import ByteConnection
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import ConnectionLost


class BridgeCable:
    """A simulated cable at the speed of the line `plant`. The gateway opens the port `gateway`, a client the port `master`."""

    def __init__(self, plant: Endpoint, inside: PtyEnd, outside: PtyEnd) -> None:
        """Create a cable that is not open; the caller uses the class method `open`."""
        self.plant = plant
        self.gateway = plant.with_path(str(inside.link))
        self.master = outside.link
        self.lost_bytes = 0
        """Number of bytes that an end did not receive because it was closed."""
        self._inside = inside
        self._outside = outside

    @classmethod
    async def open(cls, plant: Endpoint, run_dir: Path, name: str) -> BridgeCable:
        """Open both ends in `run_dir`. Raises `EndpointBusy` or `Unreachable`; then neither stays open."""
        inside = await PtyEnd.open(run_dir / f"bridge-{name}.gateway", plant)
        try:
            outside = await PtyEnd.open(run_dir / f"bridge-{name}", plant, plant.serial)
        except BaseException:
            await inside.aclose()
            raise
        return cls(plant, inside, outside)

    async def run(self) -> None:
        """Carry bytes in both directions until cancelled, or until the cable is closed."""
        async with Nursery() as nursery:
            nursery.start(self._carry(self._outside, self._inside), "towards the gateway")
            nursery.start(self._carry(self._inside, self._outside), "towards the client")
            await nursery.wait()

    async def _carry(self, source: ByteConnection, target: ByteConnection) -> None:
        while True:
            try:
                data = await source.read()
            except ConnectionLost:
                return
            try:
                await target.write(data)
            except ConnectionLost:
                self.lost_bytes += len(data)
                return

    async def aclose(self) -> None:
        await self._inside.aclose()
        await self._outside.aclose()
