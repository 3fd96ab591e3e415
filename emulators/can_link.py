"""Join two CAN buses with faults between them: third-party controllers on the near bus, third-party nodes on the far bus.

A frame from the near bus counts as a request and a frame from the far bus as a reply; the predefined connection set (CiA 301,
7.3.3) gives the node ID from the CAN identifier. Frames keep their order, except those that a fault delays. The data of
frames is not interpreted.
"""

from __future__ import annotations

import asyncio
from collections.abc import Coroutine, Sequence
from typing import Any

from fieldtwin.emulators.faults.can_engine import replaced_frames
from fieldtwin.emulators.faults.can_fault import CanFault, CanPiece
from fieldtwin.emulators.faults.engine import WireFaults, in_time
from fieldtwin.emulators.faults.fault import Active
from fieldtwin.emulators.faults.frames import FrameDirection
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.connection import CanConnection
from fieldtwin.gateway.core.errors import FieldtwinError, WireError

MOST_WAITING = 10_000
"""The number of delayed frames that may wait; further frames are lost and counted."""
NMT, NO_NODE = 0x000, 0


class CanLink:
    """A running link, from `start` to `aclose` or until one of the buses is lost; `ended` then holds the reason.

    `aclose` closes both buses.
    """

    def __init__(self, near: CanConnection, far: CanConnection, faults: WireFaults) -> None:
        self.passed = dict.fromkeys(FrameDirection, 0)
        """Frames that were forwarded, by direction."""
        self.lost = 0
        """Frames that the target bus did not accept, or for which there was no room in the queue."""
        self._near, self._far = near, far
        self._faults = faults
        self._loop = asyncio.get_running_loop()
        self._waiting: set[asyncio.TimerHandle] = set()
        self._tasks: set[asyncio.Task[None]] = set()
        self.ended: asyncio.Future[FieldtwinError] = self._loop.create_future()

    def start(self) -> None:
        """Start forwarding, and schedule the frames that faults add."""
        for way, source in ((FrameDirection.REQUEST, self._near), (FrameDirection.REPLY, self._far)):
            self._task(self._pump(source, way), f"CAN link, {way.value}")
        for active in self._faults.active.values():
            self._appear(active)

    async def aclose(self) -> None:
        """Stop, and leave both buses. Closing twice does nothing."""
        for timer in self._waiting:
            timer.cancel()
        self._waiting.clear()
        for task in tuple(self._tasks):
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        for end in (self._near, self._far):
            await end.aclose()
        self.ended.cancel()

    async def _pump(self, source: CanConnection, way: FrameDirection) -> None:
        try:
            while True:
                frame = await source.recv()
                if frame.error:
                    continue  # an error frame concerns one controller, not the bus
                for piece in self._become(frame, way):
                    if piece.delay_s <= 0:
                        await self._pass(piece.frame, way)
                    else:
                        self._later(piece.delay_s, piece.frame, way)
        except FieldtwinError as e:
            if not self.ended.done():
                self.ended.set_result(e)

    def _become(self, frame: CanFrame, way: FrameDirection) -> Sequence[CanPiece]:
        pieces = (
            replaced_frames(self._faults, way, frame, node_of(frame), self._now_ns()) if self._faults.active else None
        )
        return (CanPiece(frame),) if pieces is None else pieces

    async def _pass(self, frame: CanFrame, way: FrameDirection) -> None:
        try:
            await (self._far if way is FrameDirection.REQUEST else self._near).send(frame)
        except WireError:
            self.lost += 1  # the transmit queue stays full; the next frame may fit
        else:
            self.passed[way] += 1

    def _appear(self, active: Active) -> None:
        """Schedule the additional frames that faults send, with the identifiers of the node that is the target of the fault."""
        if not isinstance(active.fault, CanFault) or active.aim.unit is None:
            return
        wait_s = max(0.0, (active.from_ns - self._now_ns()) / NS_PER_S)
        for piece in active.fault.appears(active.aim.unit, active.random):
            self._later(piece.delay_s + wait_s, piece.frame, FrameDirection.REPLY, active)

    def _later(self, delay_s: float, frame: CanFrame, way: FrameDirection, only_while: Active | None = None) -> None:
        if len(self._waiting) >= MOST_WAITING:
            self.lost += 1
            return

        def due() -> None:
            self._waiting.discard(timer)
            if only_while is not None:
                if not in_time(only_while, self._now_ns()):
                    return
                only_while.struck += 1
            self._task(self._pass(frame, way), "a fault's frame")

        timer = self._loop.call_later(delay_s, due)
        self._waiting.add(timer)

    def _task(self, work: Coroutine[Any, Any, None], name: str) -> None:
        task = self._loop.create_task(work, name=name)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    def _now_ns(self) -> int:
        return round(self._loop.time() * NS_PER_S)


def node_of(frame: CanFrame) -> int:
    """Return the node that sends or receives a frame (CiA 301, 7.3.3); `NO_NODE` for SYNC, time stamps and broadcasts."""
    if frame.extended:
        return NO_NODE
    if frame.can_id == NMT:
        return frame.data[1] & 0x7F if len(frame.data) == 2 else NO_NODE
    return frame.can_id & 0x7F
