"""Helpers for the tests of the CANopen master: a bus in memory, jumping time, and frames in candump's notation."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Coroutine
from contextlib import asynccontextmanager
from typing import Any, TypeVar

from msgspec.structs import replace

from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.connection import CANConnection, CanConnection, closed_locally
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.protocols.canopen.master import CanopenMaster

T = TypeVar("T")


class VirtualLoop(asyncio.SelectorEventLoop):
    """A loop whose time jumps to the next timer when nothing is ready."""

    now_s = 1.0

    def time(self) -> float:
        return self.now_s

    def _run_once(self) -> None:
        if not self._ready and self._scheduled:
            self.now_s = max(self.now_s, self._scheduled[0]._when)
        super()._run_once()


class LoopClock:
    """The clock of the running loop."""

    def monotonic_ns(self) -> int:
        return round(asyncio.get_running_loop().time() * 1e9)

    def utc_ns(self) -> int:
        return self.monotonic_ns()

    async def sleep_until_ns(self, deadline_ns: int) -> None:
        await asyncio.sleep(max(0, deadline_ns - self.monotonic_ns()) / 1e9)


def run_virtual(coro: Coroutine[Any, Any, T]) -> T:
    """Run on a `VirtualLoop`, which must end without tasks."""
    loop = VirtualLoop()
    try:
        result = loop.run_until_complete(coro)
        assert not asyncio.all_tasks(loop)
        return result
    finally:
        loop.close()


class MemoryEnd(CanConnection):
    """One end of a bus of two; a sent frame gets a time stamp and reaches the other end at once."""

    def __init__(self) -> None:
        super().__init__(CANConnection(), Endpoint.parse("can:memory/test"))
        self.peer: MemoryEnd = self
        self.room = asyncio.Event()
        self.room.set()

    async def send(self, frame: CanFrame) -> None:
        await self.room.wait()
        if self.lost is not None:
            raise self.lost
        self.peer.feed(replace(frame, t_ns=LoopClock().monotonic_ns()))

    async def aclose(self) -> None:
        self.feed_lost(closed_locally(self.endpoint))


def bus() -> tuple[MemoryEnd, MemoryEnd]:
    """Two ends: the master's and the node's."""
    ours, theirs = MemoryEnd(), MemoryEnd()
    ours.peer, theirs.peer = theirs, ours
    return ours, theirs


def frame(text: str) -> CanFrame:
    """A frame in candump's notation; spaces in the data are ignored."""
    can_id, _, data = text.partition("#")
    return CanFrame(int(can_id, 16), bytes.fromhex(data))


@asynccontextmanager
async def running(master: CanopenMaster) -> AsyncIterator[asyncio.Task[None]]:
    """Run `master.run()` for the duration of the block."""
    task = asyncio.ensure_future(master.run())
    try:
        yield task
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
