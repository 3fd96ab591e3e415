"""Runs an emulated node on a CAN connection: the thin asynchronous shell around `CanopenNode`.

It must never know the protocol: it moves frames and waits.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Collection
from typing import Protocol, runtime_checkable

from emulators.canopen.node import CanopenNode
from gateway.core.canframe import CanFrame
from gateway.core.clock import NS_PER_S, Clock
from gateway.core.connection import CanConnection
from gateway.core.nursery import Nursery

Poke = Callable[[int], list[CanFrame]]
"""Something that happens in the device: called with the time, returns what the node then sends."""


@runtime_checkable
class TakesBack(Protocol):
    """A connection that can still take back what waits for the bus. A kernel's interface cannot."""

    def withdraw(self, can_ids: Collection[int], /) -> list[CanFrame]:
        """The frames that were taken back, in order."""
        ...


async def serve_node(
    connection: CanConnection, node: CanopenNode, clock: Clock, pokes: asyncio.Queue[Poke] | None = None
) -> None:
    """Power the node on and serve it until cancelled. What is put into `pokes` is done in between (`node.set_value`...).

    Raises `ConnectionLost` when the bus goes away, and what the node raises. The connection stays open: it is the
    caller's. Synchronous TPDOs that are late are taken back where the connection can (`TakesBack`).
    """
    connection.accept = node.accepts
    shell = _Shell(connection, node, clock)
    async with Nursery() as nursery:
        nursery.start(shell.receive(), "node: frames")
        nursery.start(shell.tick(), "node: time")
        if pokes is not None:
            nursery.start(shell.poked(pokes), "node: pokes")
        await nursery.wait()


class _Shell:
    """A node between frames and time. One thing at a time: what follows from it is sent before the next is looked at."""

    def __init__(self, connection: CanConnection, node: CanopenNode, clock: Clock) -> None:
        self._connection = connection
        self._node = node
        self._clock = clock
        self._turn = asyncio.Lock()
        self._woken = asyncio.Event()
        self._timer: asyncio.TimerHandle | None = None
        self._timer_ns: int | None = None

    async def receive(self) -> None:
        await self._do(self._node.start)
        while True:
            frame = await self._connection.recv()
            await self._do(lambda now_ns, frame=frame: self._node.feed(frame, now_ns))  # type: ignore[misc]

    async def tick(self) -> None:
        try:
            while True:
                await self._woken.wait()
                self._woken.clear()
                self._timer = self._timer_ns = None
                await self._do(self._node.tick)
        finally:
            if self._timer is not None:
                self._timer.cancel()

    async def poked(self, pokes: asyncio.Queue[Poke]) -> None:
        while True:
            await self._do(await pokes.get())

    async def _do(self, what: Poke) -> None:
        async with self._turn:
            await self._send(what(self._clock.monotonic_ns()))
            overdue = self._node.take_overdue()
            if overdue and isinstance(self._connection, TakesBack):
                dropped = self._connection.withdraw(overdue)
                await self._send(self._node.dropped(dropped, self._clock.monotonic_ns()))
            self._set_timer()

    async def _send(self, frames: list[CanFrame]) -> None:
        for frame in frames:
            await self._connection.send(frame)

    def _set_timer(self) -> None:
        wake_ns = self._node.wake_at_ns()
        if wake_ns == self._timer_ns:
            return
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        self._timer_ns = wake_ns
        if wake_ns is not None:
            left_s = (wake_ns - self._clock.monotonic_ns()) / NS_PER_S
            self._timer = asyncio.get_running_loop().call_later(max(0.0, left_s), self._woken.set)
