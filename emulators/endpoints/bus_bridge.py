"""Two CAN buses joined: what is on one is sent on the other, both ways. For the software bus and a kernel's interface.

Nothing comes back: neither end receives what it sent itself, so a frame crosses once. Error frames stay where they are: they tell
of one controller, not of a bus. A bus that is full holds the other direction's frames back, in a bounded queue; what comes beyond
it is lost and counted. What the frames mean is not known here.
"""

from __future__ import annotations

import asyncio

from fieldtwin.gateway.core.connection import CanConnection
from fieldtwin.gateway.core.errors import FieldtwinError, WireError


class CanBridge:
    """Runs from `start` to `aclose`, or until one of the two buses is gone: `ended` then gives why."""

    def __init__(self, one: CanConnection, other: CanConnection) -> None:
        self.forwarded = {str(one.endpoint): 0, str(other.endpoint): 0}
        """Frames by the endpoint that they came from."""
        self._ends = (one, other)
        self._refused = 0
        self._tasks: list[asyncio.Task[None]] = []
        self.ended: asyncio.Future[FieldtwinError] = asyncio.get_running_loop().create_future()

    def start(self) -> None:
        """Forward from now on."""
        one, other = self._ends
        for source, sink in ((one, other), (other, one)):
            task = asyncio.create_task(self._pump(source, sink), name=f"bridge {source.endpoint}")
            self._tasks.append(task)

    @property
    def lost(self) -> int:
        """Frames that came faster than the other bus took them."""
        return self._refused + sum(end.overruns for end in self._ends)

    async def aclose(self) -> None:
        """Stop, and leave both buses. Closing twice does nothing."""
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        self._tasks = []
        for end in self._ends:
            await end.aclose()
        self.ended.cancel()

    async def _pump(self, source: CanConnection, sink: CanConnection) -> None:
        where = str(source.endpoint)
        try:
            while True:
                frame = await source.recv()
                if frame.error:
                    continue
                try:
                    await sink.send(frame)
                except WireError:
                    self._refused += 1  # a transmit queue that stays full; the next one may fit
                else:
                    self.forwarded[where] += 1
        except FieldtwinError as e:
            if not self.ended.done():
                self.ended.set_result(e)
