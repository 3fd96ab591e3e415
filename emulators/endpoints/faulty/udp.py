"""An emulator's UDP socket with fault injection: each datagram is a frame.

There is no connection that a fault could close.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable
from dataclasses import replace

from fieldtwin.emulators.endpoints.ports import Datagrams
from fieldtwin.emulators.faults.engine import WireFaults
from fieldtwin.emulators.faults.fault import DelayedBytes, FaultEffect
from fieldtwin.emulators.faults.frames import FrameDirection, understood
from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import ConnectionLost

MOST_WAITING = 1_000
"""The number of received datagrams that may wait for their reader. Further datagrams are lost, as with a socket."""

Heard = tuple[bytes, tuple[str, int]]


class FaultyDatagrams(Datagrams):
    """A wrapper that injects `faults` into the socket `inner`. Close this object instead of `inner`."""

    def __init__(self, inner: Datagrams, faults: WireFaults) -> None:
        self._inner = inner
        self._faults = faults
        self._loop = asyncio.get_running_loop()
        self._heard: asyncio.Queue[Heard | ConnectionLost] = asyncio.Queue(MOST_WAITING)
        self._tasks: set[asyncio.Task[None]] = set()
        self._asked: dict[tuple[str, int], tuple[int, int]] = {}
        self._listening = self._loop.create_task(self._listen(), name=f"datagrams at {inner.bound}")

    @property
    def bound(self) -> Endpoint:
        return self._inner.bound

    async def receive(self) -> Heard:
        heard = await self._heard.get()
        if isinstance(heard, ConnectionLost):
            raise heard
        return heard

    async def send(self, data: bytes, peer: tuple[str, int]) -> None:
        address, count = self._asked.pop(peer, (-1, -1))
        frame = replace(understood(FrameDirection.REPLY, self._faults.framing, data), address=address, count=count)
        outcome = self._faults.decide(frame, round(self._loop.time() * NS_PER_S))
        for piece in (outcome or FaultEffect((DelayedBytes(data),))).pieces:
            if piece.back:
                self._pass_in(piece.data, peer)
            elif piece.delay_s > 0:
                self._later(piece, self._send, peer)
            else:
                await self._inner.send(piece.data, peer)
                self._show(FrameDirection.REPLY, piece.data, peer)

    async def aclose(self) -> None:
        for task in (self._listening, *self._tasks):
            task.cancel()
        await asyncio.gather(self._listening, *self._tasks, return_exceptions=True)
        await self._inner.aclose()

    def _pass_in(self, data: bytes, peer: tuple[str, int]) -> None:
        if not self._heard.full():
            self._heard.put_nowait((data, peer))

    def _send(self, data: bytes, peer: tuple[str, int]) -> None:
        if len(self._tasks) < MOST_WAITING:
            task = self._loop.create_task(self._send_quietly(data, peer), name="a fault's datagram")
            self._tasks.add(task)
            task.add_done_callback(self._tasks.discard)

    async def _send_quietly(self, data: bytes, peer: tuple[str, int]) -> None:
        with contextlib.suppress(ConnectionLost):  # the connection was lost before the delayed bytes were sent
            await self._inner.send(data, peer)
            self._show(FrameDirection.REPLY, data, peer)

    def _show(self, way: FrameDirection, data: bytes, peer: tuple[str, int]) -> None:
        if self._faults.watch is not None:
            self._faults.watch(peer, way, data)

    def _later(
        self, piece: DelayedBytes, then: Callable[[bytes, tuple[str, int]], None], peer: tuple[str, int]
    ) -> None:
        """Call `then` when the piece is due, unless the piece has already been forwarded."""

        def due() -> None:
            if not self._listening.done() and (piece.gone is None or not piece.gone()):
                then(piece.data, peer)

        self._loop.call_later(piece.delay_s, due)

    async def _listen(self) -> None:
        try:
            while True:
                data, peer = await self._inner.receive()
                self._show(FrameDirection.REQUEST, data, peer)
                frame = understood(FrameDirection.REQUEST, self._faults.framing, data)
                if len(self._asked) < MOST_WAITING:
                    self._asked[peer] = frame.address, frame.count
                outcome = self._faults.decide(frame, round(self._loop.time() * NS_PER_S))
                for piece in (outcome or FaultEffect((DelayedBytes(data),))).pieces:
                    if piece.back:
                        self._send(piece.data, peer)
                    elif piece.delay_s > 0:
                        self._later(piece, self._pass_in, peer)
                    else:
                        self._pass_in(piece.data, peer)
        except ConnectionLost as e:
            await self._heard.put(e)
