"""An emulator's end of a wire with faults on it: what it hears and says passes through the bus's faults.

Neither side knows. Time is the loop's. While no fault is in, bytes pass as they are.
"""

from __future__ import annotations

import asyncio
from collections.abc import Coroutine
from dataclasses import replace
from typing import Any

from fieldtwin.emulators.endpoints.pty import PtyEnd
from fieldtwin.emulators.endpoints.socket_end import SocketEnd
from fieldtwin.emulators.faults.engine import WireFaults, in_time
from fieldtwin.emulators.faults.fault import Active, Hang, Outcome, Piece, WireFault
from fieldtwin.emulators.faults.frames import FLUSH_S, Assembler, Frame, Way
from fieldtwin.emulators.virtual.wire import MemoryEnd
from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.connection import PROTOCOL, ByteConnection
from fieldtwin.gateway.core.errors import ConnectionLost, FieldtwinError

MOST_WAITING = 10_000
"""Pieces that wait for their time; what is more is lost and counted."""


class FaultyEnd(ByteConnection):
    """`inner`, an emulator's end, behind `faults`. Close it instead of `inner`."""

    def __init__(self, inner: ByteConnection, faults: WireFaults) -> None:
        super().__init__(inner.inbound, inner.endpoint, inner.max_pending)
        self.inner = inner
        self._pty = inner if isinstance(inner, PtyEnd) else None
        self.peer = getattr(inner, "peer", "")
        self.host = getattr(inner, "host", "")
        self.role = getattr(inner, "role", "")
        self.lost_pieces = 0
        """Pieces that were lost because too many waited."""
        self._faults = faults
        self._loop = asyncio.get_running_loop()
        self._requests = Assembler(Way.REQUEST, faults.framing)
        self._replies = Assembler(Way.REPLY, faults.framing)
        self._free_ns: dict[Way, int] = {}
        """Until when what was put off keeps a way, so that nothing overtakes it; a way that is free is not in it."""
        self._gathered: dict[Way, bytearray] = {}
        self._asked: Frame | None = None
        self._dead = False
        self._waiting = 0
        self._tasks: set[asyncio.Task[None]] = set()
        self._flush: asyncio.TimerHandle | None = None
        inner.intercept = self._heard
        faults.listeners.append(self._put_in)
        for active in faults.active.values():  # what was put in before this connection came
            self._put_in(active)

    # -- as a connection ------------------------------------------------------------------------------------------------

    @property
    def lost(self) -> FieldtwinError | None:
        return self.inner.lost

    @property
    def paced(self) -> bool:
        """Whether the end keeps a line's time by itself (`PtyEnd`)."""
        return self._pty is not None and self._pty.paced

    def read(self) -> Coroutine[Any, Any, bytes]:
        return self.inner.read()

    def read_within(self, timeout_s: float) -> Coroutine[Any, Any, bytes]:
        return self.inner.read_within(timeout_s)

    def read_pending(self) -> bytes:
        return self.inner.read_pending()

    async def write(self, data: bytes) -> None:
        if self._passes(self._replies) and not self._dead:  # as a rule: no fault is in
            await self.inner.write(data)
            if self._faults.watch is not None:
                self._show(Way.REPLY, data)
            return
        for piece in self._said(data):
            await self.inner.write(piece)
            self._show(Way.REPLY, piece)

    async def answer(self, data: bytes, after_s: float) -> None:
        """As `PtyEnd.answer`."""
        assert self._pty is not None
        for n, piece in enumerate(self._said(data, after_s)):
            await (self._pty.answer(piece, after_s) if n == 0 else self._pty.write(piece))
            self._show(Way.REPLY, piece)

    async def aclose(self) -> None:
        self.detach()
        await self.inner.aclose()

    def detach(self) -> None:
        """Faults no longer strike here; `inner` stays as it is."""
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

    def _show(self, way: Way, data: bytes) -> None:
        if self._faults.watch is not None:
            self._faults.watch(self, way, data)

    def _passes(self, assembler: Assembler) -> bool:
        """Whether bytes pass as they are: no fault is in, and nothing that one kept is still on its way."""
        return not (self._faults.active or assembler.pending or (self._free_ns and assembler.way in self._free_ns))

    def _heard(self, data: bytes) -> bool:
        """A chunk from the other side; True: it is dealt with."""
        if self._faults.watch is not None:
            self._show(Way.REQUEST, data)
        if self._dead:
            return True
        assembler = self._requests
        if self._passes(assembler):
            return False
        for frame in assembler.feed(data):
            self._on_request(frame)
        self._flush_later()
        return True

    def _on_request(self, frame: Frame) -> None:
        if frame.pdu:
            self._asked = frame
        outcome = self._faults.decide(frame, self._now_ns())
        for piece in self._carry_out(Way.REQUEST, outcome or Outcome((Piece(frame.data),))):
            self._pass_in(piece)

    def _flush_later(self) -> None:
        """What makes no frame goes on by and by."""
        if self._flush is not None:
            self._flush.cancel()
            self._flush = None
        if self._requests.pending and not self._faults.framing.streams:
            self._flush = self._loop.call_later(FLUSH_S, self._flush_now)

    def _flush_now(self) -> None:
        for frame in self._requests.flush():
            self._on_request(frame)

    def _said(self, data: bytes, after_s: float = 0.0) -> list[bytes]:
        """What of an emulator's reply goes out at once; the rest is on its way."""
        if self._dead:
            return []
        assembler = self._replies
        if self._passes(assembler):
            return [data]
        frames = assembler.feed(data)
        if not self._faults.framing.streams:
            frames += assembler.flush()
        out: list[bytes] = []
        for frame in frames:
            if self._asked is not None:
                frame = replace(frame, address=self._asked.address, count=self._asked.count)
            outcome = self._faults.decide(frame, self._now_ns())
            out += self._carry_out(Way.REPLY, outcome or Outcome((Piece(frame.data),)), after_s)
        return out

    # -- carrying out ---------------------------------------------------------------------------------------------------

    def _carry_out(self, way: Way, outcome: Outcome, after_s: float = 0.0) -> list[bytes]:
        """The pieces that go on at once; those of another time or way are seen to here."""
        now_ns = self._now_ns()
        at_once: list[bytes] = []
        for piece in outcome.pieces:
            if piece.back:
                self._send(Way.REPLY if way is Way.REQUEST else Way.REQUEST, piece.data)
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
        if outcome.hang is not None:
            self._hang(outcome.hang, at_once)
        return [] if self._dead else at_once

    def _gather(self, way: Way, piece: Piece) -> None:
        if way in self._gathered:
            self._gathered[way] += piece.data
            return
        self._gathered[way] = bytearray(piece.data)
        self._loop.call_later(piece.delay_s, lambda: self._send(way, bytes(self._gathered.pop(way))))

    def _send_at(self, due_ns: int, way: Way, piece: Piece) -> None:
        if self._waiting >= MOST_WAITING:
            self.lost_pieces += 1
            return
        self._waiting += 1
        self._loop.call_at(due_ns / NS_PER_S, self._due, way, piece)

    def _due(self, way: Way, piece: Piece) -> None:
        self._waiting -= 1
        if piece.gone is None or not piece.gone():
            self._send(way, piece.data)

    def _send(self, way: Way, data: bytes) -> None:
        if self._dead or self.inner.lost is not None or not data:
            return
        if way is Way.REQUEST:
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
            self._show(Way.REPLY, data)
        except ConnectionLost:
            pass  # it was too late

    def _pass_in(self, data: bytes) -> None:
        if data:
            self.inner.feed_through(data)

    # -- the connection itself ------------------------------------------------------------------------------------------

    def _put_in(self, active: Active) -> None:
        """A fault that ends connections does so when its time comes."""
        hang = active.fault.appears() if isinstance(active.fault, WireFault) else None
        if hang is None:
            return
        wait_s = max(0.0, (active.from_ns - self._now_ns()) / NS_PER_S)
        self._loop.call_later(wait_s, self._appear, active, hang)

    def _appear(self, active: Active, hang: Hang) -> None:
        if active.id in self._faults.active and in_time(active, self._now_ns()):
            active.struck += 1
            self._hang(hang, [])

    def _hang(self, hang: Hang, last: list[bytes]) -> None:
        in_memory = isinstance(self.inner, MemoryEnd) and self.inner.wire.serial
        if self._dead or in_memory or self.inner.type is PROTOCOL.RS232:
            return  # a serial line cannot be ended: what is said on it is lost by the fault itself
        if hang is Hang.HALF_OPEN:
            self._dead = True
            return
        for data in last:
            self._start(data)
        self._dead = True
        self._loop.call_soon(self._end, hang)

    def _end(self, hang: Hang) -> None:
        if isinstance(self.inner, MemoryEnd):
            self.inner.wire.cut(ConnectionLost("the other side ended the connection", where=str(self.endpoint)))
        elif isinstance(self.inner, SocketEnd):
            self.inner.evict(reset=hang is Hang.RESET)
        else:
            task = self._loop.create_task(self.inner.aclose(), name="a fault's end of a connection")
            self._tasks.add(task)
            task.add_done_callback(self._tasks.discard)
