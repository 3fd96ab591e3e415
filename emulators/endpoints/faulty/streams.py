"""An emulator's end of a link with fault injection: the bytes in both directions pass through the faults of the bus.

Neither side can detect the wrapper. All times are those of the event loop. While no fault is active, bytes pass unchanged.
"""

from __future__ import annotations

import asyncio
from collections.abc import Coroutine
from dataclasses import replace
from typing import Any

from fieldtwin.emulators.endpoints.pty import PtyEnd
from fieldtwin.emulators.endpoints.socket_end import SocketEnd
from fieldtwin.emulators.faults.engine import WireFaults, in_time
from fieldtwin.emulators.faults.fault import Active, ConnectionEffect, DelayedBytes, FaultEffect, WireFault
from fieldtwin.emulators.faults.frames import FLUSH_S, Assembler, FaultFrame, FrameDirection
from fieldtwin.emulators.virtual.memory_stream import MemoryEnd
from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.connection import PROTOCOL, ByteConnection
from fieldtwin.gateway.core.errors import ConnectionLost, FieldtwinError

MOST_WAITING = 10_000
"""The number of pieces (chunks of bytes) that may wait for the end of their delay. Further pieces are lost and counted."""


class FaultyEnd(ByteConnection):
    """A wrapper that injects `faults` into `inner`, an emulator's end. Close this object instead of `inner`."""

    def __init__(self, inner: ByteConnection, faults: WireFaults) -> None:
        super().__init__(inner.inbound, inner.endpoint, inner.max_pending)
        self.inner = inner
        self._pty = inner if isinstance(inner, PtyEnd) else None
        self.peer = getattr(inner, "peer", "")
        self.host = getattr(inner, "host", "")
        self.role = getattr(inner, "role", "")
        self.lost_pieces = 0
        """The number of pieces that were lost because too many pieces waited."""
        self._faults = faults
        self._loop = asyncio.get_running_loop()
        self._requests = Assembler(FrameDirection.REQUEST, faults.framing)
        self._replies = Assembler(FrameDirection.REPLY, faults.framing)
        self._free_ns: dict[FrameDirection, int] = {}
        """The time until which delayed bytes block a direction, so that later bytes do not overtake them; absent if it
        is free.
        """
        self._gathered: dict[FrameDirection, bytearray] = {}
        self._asked: FaultFrame | None = None
        self._dead = False
        self._waiting = 0
        self._tasks: set[asyncio.Task[None]] = set()
        self._flush: asyncio.TimerHandle | None = None
        inner.intercept = self._apply_to_request
        faults.listeners.append(self._put_in)
        for active in faults.active.values():  # faults that were injected before this connection was opened
            self._put_in(active)

    # -- connection interface -------------------------------------------------------------------------------------------

    @property
    def lost(self) -> FieldtwinError | None:
        return self.inner.lost

    @property
    def paced(self) -> bool:
        """Return whether the end paces bytes like a line (`PtyEnd`)."""
        return self._pty is not None and self._pty.paced

    def read(self) -> Coroutine[Any, Any, bytes]:
        return self.inner.read()

    def read_within(self, timeout_s: float) -> Coroutine[Any, Any, bytes]:
        return self.inner.read_within(timeout_s)

    def read_pending(self) -> bytes:
        return self.inner.read_pending()

    async def write(self, data: bytes) -> None:
        for piece in self._apply_to_reply(data):
            await self.inner.write(piece)
            self._show(FrameDirection.REPLY, piece)

    async def answer(self, data: bytes, after_s: float) -> None:
        """Send a reply as `PtyEnd.answer` does, after the faults were applied to it."""
        assert self._pty is not None
        for n, piece in enumerate(self._apply_to_reply(data, after_s)):
            await (self._pty.answer(piece, after_s) if n == 0 else self._pty.write(piece))
            self._show(FrameDirection.REPLY, piece)

    async def aclose(self) -> None:
        self.detach()
        await self.inner.aclose()

    def detach(self) -> None:
        """Disconnect from the faults; `inner` stays open."""
        self._close()
        self.inner.intercept = None

    def _close(self) -> None:
        self._dead = True
        if self._put_in in self._faults.listeners:
            self._faults.listeners.remove(self._put_in)
        if self._flush is not None:
            self._flush.cancel()
        for task in tuple(self._tasks):
            task.cancel()

    # -- frames ---------------------------------------------------------------------------------------------------------

    def _now_ns(self) -> int:
        return round(self._loop.time() * NS_PER_S)

    def _show(self, way: FrameDirection, data: bytes) -> None:
        if self._faults.watch is not None:
            self._faults.watch(self, way, data)

    def _is_inactive(self, assembler: Assembler) -> bool:
        """Return whether bytes pass unchanged: no fault is active, and no delayed bytes are waiting."""
        return not (self._faults.active or assembler.pending or (self._free_ns and assembler.way in self._free_ns))

    def _apply_to_request(self, data: bytes) -> bool:
        """Handle a chunk from the peer. Return True if a fault was applied to it, so that it must not be passed on unchanged."""
        if self._faults.watch is not None:
            self._show(FrameDirection.REQUEST, data)
        if self._dead:
            return True
        assembler = self._requests
        if self._is_inactive(assembler):
            return False
        for frame in assembler.feed(data):
            self._on_request(frame)
        self._flush_later()
        return True

    def _on_request(self, frame: FaultFrame) -> None:
        if frame.pdu:
            self._asked = frame
        outcome = self._faults.decide(frame, self._now_ns())
        for piece in self._carry_out(FrameDirection.REQUEST, outcome or FaultEffect((DelayedBytes(frame.data),))):
            self._pass_in(piece)

    def _flush_later(self) -> None:
        """Schedule the forwarding of bytes that form no frame."""
        if self._flush is not None:
            self._flush.cancel()
            self._flush = None
        if self._requests.pending and not self._faults.framing.streams:
            self._flush = self._loop.call_later(FLUSH_S, self._flush_now)

    def _flush_now(self) -> None:
        for frame in self._requests.flush():
            self._on_request(frame)

    def _apply_to_reply(self, data: bytes, after_s: float = 0.0) -> list[bytes]:
        """Apply the faults to a reply of the emulator. Return the parts to send immediately; the other parts are scheduled."""
        if self._dead:
            return []
        assembler = self._replies
        if self._is_inactive(assembler):
            return [data]
        frames = assembler.feed(data)
        if not self._faults.framing.streams:
            frames += assembler.flush()
        out: list[bytes] = []
        for frame in frames:
            if self._asked is not None:
                frame = replace(frame, address=self._asked.address, count=self._asked.count)
            outcome = self._faults.decide(frame, self._now_ns())
            out += self._carry_out(FrameDirection.REPLY, outcome or FaultEffect((DelayedBytes(frame.data),)), after_s)
        return out

    # -- carrying out ---------------------------------------------------------------------------------------------------

    def _carry_out(self, way: FrameDirection, outcome: FaultEffect, after_s: float = 0.0) -> list[bytes]:
        """Carry out the effect of a fault. Return the pieces to send immediately, and schedule those with a delay or in the
        opposite direction.
        """
        now_ns = self._now_ns()
        at_once: list[bytes] = []
        for piece in outcome.pieces:
            if piece.back:
                self._send(
                    FrameDirection.REPLY if way is FrameDirection.REQUEST else FrameDirection.REQUEST, piece.data
                )
            elif piece.gather:
                self._gather(way, piece)
            else:
                delay_ns = round(piece.delay_s * NS_PER_S)
                due_ns = now_ns + delay_ns
                if not piece.overtake:
                    due_ns = self._free_ns[way] = max(due_ns, self._free_ns.get(way, 0))
                if due_ns <= now_ns:
                    at_once.append(piece.data)
                else:
                    self._send_at(due_ns + round(after_s * NS_PER_S), way, piece)
        if self._free_ns.get(way, 0) <= now_ns:
            self._free_ns.pop(way, None)
        if outcome.connection is not None:
            self._disturb(outcome.connection, at_once)
        return [] if self._dead else at_once

    def _gather(self, way: FrameDirection, piece: DelayedBytes) -> None:
        if way in self._gathered:
            self._gathered[way] += piece.data
            return
        self._gathered[way] = bytearray(piece.data)
        self._loop.call_later(piece.delay_s, lambda: self._send(way, bytes(self._gathered.pop(way))))

    def _send_at(self, due_ns: int, way: FrameDirection, piece: DelayedBytes) -> None:
        if self._waiting >= MOST_WAITING:
            self.lost_pieces += 1
            return
        self._waiting += 1
        self._loop.call_at(due_ns / NS_PER_S, self._due, way, piece)

    def _due(self, way: FrameDirection, piece: DelayedBytes) -> None:
        self._waiting -= 1
        if piece.gone is None or not piece.gone():
            self._send(way, piece.data)

    def _send(self, way: FrameDirection, data: bytes) -> None:
        if self._dead or self.inner.lost is not None or not data:
            return
        if way is FrameDirection.REQUEST:
            self._pass_in(data)
        else:
            self._start(data)

    def _start(self, data: bytes) -> None:
        task = self._loop.create_task(self._write_quietly(data), name="a fault's frame")
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _write_quietly(self, data: bytes) -> None:
        try:
            await self.inner.write(data)
            self._show(FrameDirection.REPLY, data)
        except ConnectionLost:
            pass  # the connection was lost before the delayed bytes were sent

    def _pass_in(self, data: bytes) -> None:
        if data:
            self.inner.feed_through(data)

    # -- the connection itself ------------------------------------------------------------------------------------------

    def _put_in(self, active: Active) -> None:
        """Schedule the effect of a fault on the connection at the fault's start time."""
        effect = active.fault.appears() if isinstance(active.fault, WireFault) else None
        if effect is None:
            return
        wait_s = max(0.0, (active.from_ns - self._now_ns()) / NS_PER_S)
        self._loop.call_later(wait_s, self._appear, active, effect)

    def _appear(self, active: Active, effect: ConnectionEffect) -> None:
        if active.id in self._faults.active and in_time(active, self._now_ns()):
            active.struck += 1
            self._disturb(effect, [])

    def _disturb(self, effect: ConnectionEffect, last: list[bytes]) -> None:
        in_memory = isinstance(self.inner, MemoryEnd) and self.inner.wire.serial
        if self._dead or in_memory or self.inner.type is PROTOCOL.RS232:
            return  # a serial line cannot be closed: the fault itself drops the bytes
        if effect is ConnectionEffect.HALF_OPEN:
            self._dead = True
            return
        for data in last:
            self._start(data)
        self._dead = True
        self._loop.call_soon(self._end, effect)

    def _end(self, effect: ConnectionEffect) -> None:
        if isinstance(self.inner, MemoryEnd):
            self.inner.wire.cut(ConnectionLost("the other side ended the connection", where=str(self.endpoint)))
        elif isinstance(self.inner, SocketEnd):
            self.inner.evict(reset=effect is ConnectionEffect.RESET)
        else:
            task = self._loop.create_task(self.inner.aclose(), name="a fault's end of a connection")
            self._tasks.add(task)
            task.add_done_callback(self._tasks.discard)
