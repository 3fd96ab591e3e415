"""Modbus TCP clients of the gateway, with TLS or without: their connections, requests in order, answers in the same order.

Who answers is not known here: `ask` is given a request and returns its answer, or a promise of one. A client may have so
many requests under way and no more (exception 06, case MB-053); one that does not read its answers is not read either.
When it goes, its promises are cancelled: nobody waits for them any more (case MB-060).
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from gateway.connections.listeners import TcpListener
from gateway.core.clock import NS_PER_S, Clock
from gateway.core.connection import Client, Clients, Listen
from gateway.core.endpoint import Endpoint
from gateway.core.errors import Unreachable
from gateway.core.nursery import Nursery
from gateway.protocols.modbus.refusals import refusal
from gateway.protocols.modbus.server import SERVER_BUSY, exception_pdu
from gateway.protocols.modbus.server_mbap import MbapRequests, TcpRequest
from gateway.runtime.backoff import Backoff

MOST_UNSENT = 64
"""Answers that may wait for a client to read; then no more of its requests are taken."""


@dataclass(frozen=True, slots=True)
class Caller:
    """Who asks: `name` tells one connection from another, `address` and `role` are what allow-lists know. The role is the
    one in the client's certificate (MBTLS 8.4), empty without one."""

    name: str
    address: str
    role: str = ""

    @property
    def on_record(self) -> str:
        """As audit logs name it."""
        return f"{self.name} ({self.role})" if self.role else self.name


Answer = bytes | None | asyncio.Future[bytes | None]
"""A response PDU, None for silence, or a promise of either."""

Ask = Callable[[Caller, int, bytes], Answer]
"""``(caller, unit, request PDU)``. Never waits and never raises for what a client says."""


@dataclass
class FrontCounters:
    """Requests taken; refused because too many were under way; ADUs of other protocols; streams that made no sense."""

    requests: int = 0
    busy: int = 0
    foreign: int = 0
    desyncs: int = 0


class TcpFront:
    """A listening port, until cancelled. A port that cannot be had is tried again, and the status says so; with `insist`
    False it is the end (`EndpointBusy`, `Unreachable`)."""

    def __init__(
        self,
        endpoint: Endpoint,
        ask: Ask,
        clock: Clock,
        *,
        max_clients: int = 16,
        in_flight: int = 16,
        admits: Callable[[str], bool] = lambda address: True,
        insist: bool = True,
        idle_s: float = 0.0,
        listen: Listen = TcpListener.open,
    ) -> None:
        self.endpoint = endpoint
        self.counters = FrontCounters()
        self.listener: Clients | None = None
        self.error = ""
        self._ask = ask
        self._clock = clock
        self._max_clients = max_clients
        self._in_flight = in_flight
        self._admits = admits
        self._insist = insist
        self._idle_s = idle_s
        self._listen = listen

    @property
    def bound(self) -> Endpoint | None:
        """Where it listens, with the port that was taken; None while it does not."""
        return self.listener.bound if self.listener is not None else None

    async def run(self) -> None:
        """Listen, again and again until it works, and serve until cancelled."""
        backoff = Backoff(0.25, 5.0)
        while self.listener is None:
            try:
                self.listener = await self._listen(
                    self.endpoint, self._serve, self._max_clients, self._admits, self._idle_s
                )
            except Unreachable as e:
                if not self._insist:
                    raise
                self.error = str(e)
                await self._clock.sleep_until_ns(self._clock.monotonic_ns() + int(backoff.next_s() * NS_PER_S))
        self.error = ""
        try:
            await asyncio.get_running_loop().create_future()  # until cancelled
        finally:
            await self.listener.aclose()
            self.listener = None

    def describe(self) -> dict[str, Any]:
        """For the status."""
        c, listener = self.counters, self.listener
        return {
            "listening": str(listener.bound) if listener is not None else None,
            "error": self.error,
            "clients": [f"{x.peer}:{x.peer_port}" for x in listener.clients] if listener is not None else [],
            "accepted": listener.accepted if listener is not None else 0,
            "evicted": listener.evicted if listener is not None else 0,
            "turned_away": listener.refused if listener is not None else 0,
            "unshaken": listener.unshaken if listener is not None else 0,
            "retired": listener.retired if listener is not None else 0,
            "requests": c.requests,
            "busy": c.busy,
            "foreign": c.foreign,
            "desyncs": c.desyncs,
        }

    async def _serve(self, connection: Client) -> None:
        session = _Session(connection, self._ask, self._in_flight, self.counters)
        await session.run()


class _Session:
    """One client."""

    def __init__(self, connection: Client, ask: Ask, in_flight: int, counters: FrontCounters) -> None:
        self._connection = connection
        self._caller = Caller(f"{connection.peer}:{connection.peer_port}", connection.peer, connection.role)
        self._ask = ask
        self._in_flight = in_flight
        self._counters = counters
        self._waiting: deque[tuple[TcpRequest, Answer]] = deque()
        self._news = asyncio.Event()
        self._room = asyncio.Event()

    async def run(self) -> None:
        """Until the client goes (`ConnectionLost`), or its stream makes no sense any more."""
        stream = MbapRequests()
        try:
            async with Nursery() as nursery:
                writer = nursery.start(self._write(), "answers")
                while not stream.desync:
                    data = await self._connection.read()
                    foreign = stream.foreign
                    for request in stream.feed(data):
                        await self._take(request, writer)
                    self._counters.foreign += stream.foreign - foreign
                self._counters.desyncs += 1
        finally:
            for _, answer in self._waiting:
                if isinstance(answer, asyncio.Future):
                    answer.cancel()

    async def _take(self, request: TcpRequest, writer: asyncio.Task[None]) -> None:
        while len(self._waiting) >= MOST_UNSENT and not writer.done():
            self._room.clear()
            await self._room.wait()
        self._counters.requests += 1
        answer: Answer
        if sum(isinstance(a, asyncio.Future) and not a.done() for _, a in self._waiting) >= self._in_flight:
            self._counters.busy += 1
            answer = exception_pdu(refusal(request.pdu[0], SERVER_BUSY))
        else:
            answer = self._ask(self._caller, request.unit, request.pdu)
        self._waiting.append((request, answer))
        self._news.set()

    async def _write(self) -> None:
        """The answers, in the order of the requests (case MB-052)."""
        try:
            while True:
                while self._waiting:
                    request, answer = self._waiting[0]
                    pdu = await answer if isinstance(answer, asyncio.Future) else answer
                    self._waiting.popleft()
                    if pdu is not None:
                        await self._connection.write(request.reply(pdu))
                    self._room.set()
                self._news.clear()
                await self._news.wait()
        finally:
            self._room.set()
