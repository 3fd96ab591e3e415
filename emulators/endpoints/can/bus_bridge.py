"""Join two CAN buses, on the software bus or kernel interfaces: each frame on one bus is also sent on the other bus.

Frames are not sent back, because an end does not receive the frames that it sent itself. Error frames are not forwarded: they
concern one controller, not a bus. While one bus is full, the frames of the other direction wait in a bounded queue;
further frames are lost and counted. The bridge does not interpret frames.
"""

from __future__ import annotations

import asyncio

from fieldtwin.gateway.core.connection import CanConnection
from fieldtwin.gateway.core.errors import FieldtwinError, WireError


class CanBridge:
    """A running bridge, from `start` to `aclose` or until one of the buses is lost; `ended` then holds the reason."""

    def __init__(self, one: CanConnection, other: CanConnection) -> None:
        self.forwarded = {str(one.endpoint): 0, str(other.endpoint): 0}
        """The number of forwarded frames, by the endpoint from which they came."""
        self._ends = (one, other)
        self._refused = 0
        self._tasks: list[asyncio.Task[None]] = []
        self.ended: asyncio.Future[FieldtwinError] = asyncio.get_running_loop().create_future()

    def start(self) -> None:
        """Start forwarding."""
        one, other = self._ends
        for source, sink in ((one, other), (other, one)):
            task = asyncio.create_task(self._pump(source, sink), name=f"bridge {source.endpoint}")
            self._tasks.append(task)

    @property
    def lost(self) -> int:
        """Return the number of frames that were lost because they arrived faster than the target bus accepted them."""
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
                    self._refused += 1  # the transmit queue stays full; the next frame may fit
                else:
                    self.forwarded[where] += 1
        except FieldtwinError as e:
            if not self.ended.done():
                self.ended.set_result(e)
