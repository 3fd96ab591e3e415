"""Runs an emulated node on a CAN connection: the thin asynchronous shell around `CanopenNode`.

It must never know the protocol: it moves frames and waits.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable

from emulators.canopen.node import CanopenNode
from gateway.core.canframe import CanFrame
from gateway.core.clock import Clock
from gateway.core.connection import CanConnection

Poke = Callable[[int], list[CanFrame]]
"""Something that happens in the device: called with the time, returns what the node then sends."""


async def serve_node(
    connection: CanConnection, node: CanopenNode, clock: Clock, pokes: asyncio.Queue[Poke] | None = None
) -> None:
    """Power the node on and serve it until cancelled. What is put into `pokes` is done in between (`node.set_value`...).

    Raises `ConnectionLost` when the bus goes away, and what the node raises. The connection stays open: it is the
    caller's.
    """
    connection.accept = node.accepts
    receiving: asyncio.Task[CanFrame] = asyncio.create_task(connection.recv())
    poked: asyncio.Task[Poke] | None = asyncio.create_task(pokes.get()) if pokes else None
    sleeping: asyncio.Task[None] | None = None
    slept_until_ns: int | None = None
    try:
        await _send(connection, node.start(clock.monotonic_ns()))
        while True:
            wake_ns = node.wake_at_ns()
            if wake_ns != slept_until_ns or (sleeping is not None and sleeping.done()):
                await _cancel(sleeping)
                sleeping = None if wake_ns is None else asyncio.create_task(clock.sleep_until_ns(wake_ns))
                slept_until_ns = wake_ns
            await asyncio.wait([t for t in (receiving, sleeping, poked) if t], return_when=asyncio.FIRST_COMPLETED)
            if receiving.done():
                frame = receiving.result()
                receiving = asyncio.create_task(connection.recv())
                await _send(connection, node.feed(frame, clock.monotonic_ns()))
            elif poked is not None and pokes is not None and poked.done():
                poke = poked.result()
                poked = asyncio.create_task(pokes.get())
                await _send(connection, poke(clock.monotonic_ns()))
            else:
                if sleeping is not None:
                    sleeping.result()  # a clock that fails is told, not retried for ever
                await _send(connection, node.tick(clock.monotonic_ns()))
    finally:
        await _cancel(receiving)
        await _cancel(poked)
        await _cancel(sleeping)


async def _send(connection: CanConnection, frames: list[CanFrame]) -> None:
    for frame in frames:
        await connection.send(frame)


async def _cancel(task: asyncio.Task[CanFrame] | asyncio.Task[None] | asyncio.Task[Poke] | None) -> None:
    """End a task of ours and take its outcome, so that none is reported as never retrieved."""
    if task is not None:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
