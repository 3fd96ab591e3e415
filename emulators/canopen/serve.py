"""Run an emulated node on a CAN connection: the asynchronous code around `CanopenNode`.

This module must not depend on the protocol: it only moves frames and waits.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Collection
from functools import partial
from typing import Protocol, runtime_checkable

from fieldtwin.emulators.canopen.node import CanopenNode
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.clock import NS_PER_S, Clock
from fieldtwin.gateway.core.concurrency.nursery import Nursery
from fieldtwin.gateway.core.connection import CanConnection

Poke = Callable[[int], list[CanFrame]]
"""An event inside the device: a function that is called with the time and returns the frames that the node then sends."""


@runtime_checkable
class WithdrawsFrames(Protocol):
    """A connection that can withdraw frames which still wait for the bus. A kernel interface cannot do this."""

    def withdraw(self, can_ids: Collection[int], /) -> list[CanFrame]:
        """Withdraw waiting frames and return them in order."""
        ...


@runtime_checkable
class SendsAtOnce(Protocol):
    """A connection within this process, whose queue can take a frame immediately. The queue of a socket belongs to the kernel."""

    def send_at_once(self, frame: CanFrame, /) -> bool:
        """Queue `frame` now.

        Return False, without an effect, if that would block; then use `send`. Raises `ConnectionLost`.
        """
        ...


async def serve_node(
    connection: CanConnection, node: CanopenNode, clock: Clock, pokes: asyncio.Queue[Poke] | None = None
) -> None:
    """Power the node on and serve it until cancelled. Functions from the queue `pokes` are called between other events.

    Raises `ConnectionLost` if the bus is lost, and the errors of the node. The caller owns the connection, which stays
    open. Late synchronous TPDOs are withdrawn if the connection supports it (`WithdrawsFrames`).
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
    """The event processing of a node: the output of one event is sent before the next event is processed.

    If the connection can send immediately and no other event is in progress, the event is processed in the callback
    itself, otherwise by a task that holds the lock.
    """

    def __init__(self, connection: CanConnection, node: CanopenNode, clock: Clock) -> None:
        self._connection = connection
        self._send_at_once = connection.send_at_once if isinstance(connection, SendsAtOnce) else None
        self._node = node
        self._clock = clock
        self._turn = asyncio.Lock()
        self._left: list[CanFrame] = []
        """Frames of an event for which the transmit queue had no room; the task that takes the lock next sends them first."""
        self._overdue: Collection[int] = ()
        self._failed: Exception | None = None
        self._woken = asyncio.Event()
        self._timer: asyncio.TimerHandle | None = None
        self._timer_ns: int | None = None

    async def receive(self) -> None:
        await self._do(self._node.start)
        while True:
            frame = await self._connection.recv()
            if self._may_do_at_once():
                self._do_at_once(self._node.feed(frame, self._clock.monotonic_ns()))
            else:
                await self._do(partial(self._node.feed, frame))

    async def tick(self) -> None:
        try:
            while True:
                await self._woken.wait()
                self._woken.clear()
                if self._failed is not None:
                    raise self._failed
                if self._timer is None:
                    self._timer_ns = None
                await self._do(self._node.tick)
        finally:
            if self._timer is not None:
                self._timer.cancel()

    async def poked(self, pokes: asyncio.Queue[Poke]) -> None:
        while True:
            await self._do(await pokes.get())

    def _on_time(self) -> None:
        self._timer = None
        if not self._may_do_at_once():
            self._woken.set()
            return
        self._timer_ns = None
        try:
            self._do_at_once(self._node.tick(self._clock.monotonic_ns()))
        except Exception as e:  # the error is not lost: `tick` raises it, which ends the node
            self._failed = e
            self._woken.set()

    # -- in the callback ------------------------------------------------------------------------------------------------

    def _may_do_at_once(self) -> bool:
        """Return whether the lock is free and no frames of an earlier event are unsent."""
        return self._send_at_once is not None and not (self._left or self._overdue or self._turn.locked())

    def _do_at_once(self, frames: list[CanFrame]) -> None:
        """Send the frames of an event. Frames that cannot be sent now, and the timer, are left to `tick`."""
        send_at_once = self._send_at_once
        assert send_at_once is not None
        for sent, frame in enumerate(frames):
            if not send_at_once(frame):
                self._left = frames[sent:]
                self._woken.set()
                return
        self._overdue = self._node.take_overdue()
        if self._overdue:
            self._woken.set()
        else:
            self._set_timer()

    # -- under the lock -------------------------------------------------------------------------------------------------

    async def _do(self, what: Poke) -> None:
        async with self._turn:
            await self._follow_up()
            self._left = what(self._clock.monotonic_ns())
            await self._follow_up()
            self._set_timer()

    async def _follow_up(self) -> None:
        """Send frames that an earlier event left unsent, and withdraw late frames."""
        await self._send_left()
        overdue = self._overdue or self._node.take_overdue()
        self._overdue = ()
        if overdue and isinstance(self._connection, WithdrawsFrames):
            dropped = self._connection.withdraw(overdue)
            self._left = self._node.dropped(dropped, self._clock.monotonic_ns())
            await self._send_left()

    async def _send_left(self) -> None:
        frames, self._left = self._left, []
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
            self._timer = asyncio.get_running_loop().call_later(max(0.0, left_s), self._on_time)
