"""An emulated node's end of a CAN bus with fault injection: the frames in both directions pass through the faults of
the bus.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Collection, Iterable
from typing import Any

from fieldtwin.emulators.endpoints.can.bus_runner import AttachedConnection
from fieldtwin.emulators.faults.can_engine import aimed, replaced_frames, seen
from fieldtwin.emulators.faults.can_fault import BusFault, CanFault, CanPiece
from fieldtwin.emulators.faults.engine import WireFaults, in_time
from fieldtwin.emulators.faults.fault import Active
from fieldtwin.emulators.faults.frames import FrameDirection
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.connection import CANConnection, CanConnection
from fieldtwin.gateway.core.errors import ConnectionLost, FieldtwinError


class FaultyCan(CanConnection):
    """A wrapper that injects `faults` into `inner`, the end of node `node`. Close this object instead of `inner`."""

    def __init__(self, inner: CanConnection, faults: WireFaults, node: int) -> None:
        assert isinstance(inner.inbound, CANConnection)
        super().__init__(inner.inbound, inner.endpoint, inner.max_pending)
        self.inner = inner
        self._inner_at_once = inner.send_at_once if isinstance(inner, AttachedConnection) else None
        self.node = node
        self._faults = faults
        self._loop = asyncio.get_running_loop()
        self._tasks: set[asyncio.Task[None]] = set()
        self._closed = False
        inner.accept = self._accepts
        inner.intercept = self._apply_to_request
        faults.listeners.append(self._put_in)

    @property
    def lost(self) -> FieldtwinError | None:
        return self.inner.lost

    def _accepts(self, frame: CanFrame) -> bool:
        return self.accept is None or self.accept(frame)

    async def recv(self) -> CanFrame:
        return await self.inner.recv()

    def send_at_once(self, frame: CanFrame) -> bool:
        """Queue a frame as `inner` does while no fault is active. Otherwise return False, because a fault may delay frames."""
        return self._inner_at_once is not None and not self._faults.active and self._inner_at_once(frame)

    async def send(self, frame: CanFrame) -> None:
        pieces = self._struck(FrameDirection.REPLY, frame)
        if pieces is None:
            await self.inner.send(frame)
            return
        for piece in pieces:
            if piece.delay_s <= 0:
                await self.inner.send(piece.frame)
        self._later(p for p in pieces if p.delay_s > 0)

    def withdraw(self, can_ids: Collection[int]) -> list[CanFrame]:
        """Withdraw frames that wait for the bus, as `inner` does; returns nothing if it cannot."""
        return self.inner.withdraw(can_ids) if isinstance(self.inner, AttachedConnection) else []

    async def aclose(self) -> None:
        self._closed = True
        if self._put_in in self._faults.listeners:
            self._faults.listeners.remove(self._put_in)
        for task in tuple(self._tasks):
            task.cancel()
        await self.inner.aclose()

    # -- frames ---------------------------------------------------------------------------------------------------------

    def _now_ns(self) -> int:
        return round(self._loop.time() * NS_PER_S)

    def _apply_to_request(self, frame: CanFrame) -> bool:
        pieces = self._struck(FrameDirection.REQUEST, frame)
        if pieces is None:
            return False
        for piece in pieces:
            if piece.delay_s <= 0:
                self.inner.feed_through(piece.frame)
            else:
                self._loop.call_later(piece.delay_s, self.inner.feed_through, piece.frame)
        return True

    def _struck(self, way: FrameDirection, frame: CanFrame) -> list[CanPiece] | None:
        """Return the frames that replace `frame`, or None if no fault changes it."""
        if not self._faults.active or frame.error:
            return None
        return replaced_frames(self._faults, way, frame, self.node, self._now_ns())

    def _put_in(self, active: Active) -> None:
        if not isinstance(active.fault, CanFault) or (active.units and self.node not in active.units):
            return
        pieces = active.fault.appears(self.node, active.random)
        wait_s = max(0.0, (active.from_ns - self._now_ns()) / NS_PER_S)
        for piece in pieces:
            self._loop.call_later(piece.delay_s + wait_s, self._add, active, piece.frame)

    def _add(self, active: Active, frame: CanFrame) -> None:
        """Send a frame that the fault adds, if the fault is still active."""
        if self._faults.active.get(active.id) is active and in_time(active, self._now_ns()):
            active.struck += 1
            self._start(frame)

    def _later(self, pieces: Iterable[CanPiece]) -> None:
        for piece in pieces:
            self._loop.call_later(piece.delay_s, self._start, piece.frame)

    def _start(self, frame: CanFrame) -> None:
        if self._closed:
            return
        task = self._loop.create_task(self._send_quietly(frame), name="a fault's frame")
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _send_quietly(self, frame: CanFrame) -> None:
        try:
            await self.inner.send(frame)
        except ConnectionLost:
            pass  # the connection was lost before the frame was sent


def bus_rule(active: Active, now_ns: Callable[[], int], from_nodes: frozenset[int]) -> Any:
    """Return a rule for the modelled bus (emulators/wires/can_faults.py) that destroys the nodes' frames while the
    fault lasts.
    """
    from fieldtwin.emulators.wires.can_faults import Disturbance

    assert isinstance(active.fault, BusFault)
    attempts, spoilt = active.fault.attempts, 0
    again: CanFrame | None = None

    def rule(frame: CanFrame, start_ns: int, senders: tuple[int, ...], /) -> Disturbance | None:
        nonlocal again, spoilt
        ours = any((frame.can_id & 0x7F) == node for node in from_nodes) and frame.can_id > 0x80
        if not ours or not in_time(active, now_ns()) or (attempts is not None and spoilt >= attempts):
            return None
        if attempts is None and again is not None and again.key() == frame.key():
            again = None  # its controller sends it again, successfully
            return None
        if not aimed(active, frame) or not active.applies_to(seen(FrameDirection.REPLY, frame.can_id & 0x7F), now_ns()):
            return None
        again = frame
        spoilt += 1
        active.struck += 1
        return Disturbance()

    return rule
