"""Modbus TCP clients of the gateway, with or without TLS: their connections, and answers in the order of the requests.

The function `ask`, which the caller passes, takes a request and returns its answer or a future. A
client may have a limited number of unanswered requests (further ones get exception 06, case MB-053). While a client does not read
its answers, its requests are not read either. When its connection is lost, the pending futures are cancelled, because the answers
are no longer needed (case MB-060). A client that only closes its own direction (FIN after its last request) gets its answers
before the connection is closed.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable
from dataclasses import asdict, dataclass

from fieldtwin.gateway.connections.sockets.listeners import TcpListener
from fieldtwin.gateway.core.clock import NS_PER_S, Clock
from fieldtwin.gateway.core.concurrency.nursery import Nursery
from fieldtwin.gateway.core.connection import Client, Clients, Listen
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import ConnectionLost, Unreachable
from fieldtwin.gateway.protocols.modbus.requests.refusals import refusal
from fieldtwin.gateway.protocols.modbus.server.analysis import SERVER_BUSY, exception_pdu
from fieldtwin.gateway.protocols.modbus.server.mbap import MbapRequests, TcpRequest
from fieldtwin.gateway.runtime.buses.backoff import Backoff
from fieldtwin.gateway.runtime.gateway_status import FrontStatus

REQUEST_WITHIN_S = 10.0
"""A request that has begun must be complete within this time; otherwise the client is disconnected. Without this limit, a
client that sends one byte at a time would keep its connection forever."""

MOST_UNSENT = 64
"""The number of answers that may wait for a client to read them. While more wait, no more of its requests are accepted."""


@dataclass(frozen=True, slots=True)
class Caller:
    """The sender of a request. `name` identifies the connection; allow-lists use `address` and `role`. The role is the
    one in the client's certificate (MBTLS 8.4), empty without a certificate."""

    name: str
    address: str
    role: str = ""

    @property
    def on_record(self) -> str:
        """Return the client's name for audit logs."""
        return f"{self.name} ({self.role})" if self.role else self.name


Answer = bytes | None | asyncio.Future[bytes | None]
"""A response PDU, None for no answer, or a future of either."""

Ask = Callable[[Caller, int, bytes], Answer]
"""A function that answers a request: ``(caller, unit, request PDU)``. It never waits, and never raises an error because of
what a client sends.
"""


Refused = Callable[[Caller, int, bytes, int, str], None]
"""A function that is called with a request that `Ask` never receives: ``(caller, unit, request PDU, exception code, reason)``."""


def _ignore(caller: Caller, unit: int, pdu: bytes, code: int, why: str) -> None:
    """Do nothing; the default for `Refused`."""


@dataclass
class FrontCounters:
    """Counters: accepted requests, requests refused because too many were unanswered, ADUs of other protocols, streams that could
    not be parsed, and clients whose request was not complete in time.
    """

    requests: int = 0
    busy: int = 0
    foreign: int = 0
    desyncs: int = 0
    unfinished: int = 0


class TcpFront:
    """A listening port, which runs until cancelled.

    A port that cannot be opened is tried again, and the status shows this; if `keep_trying` is False, the error ends the server
    (`EndpointBusy`, `Unreachable`).
    """

    def __init__(
        self,
        endpoint: Endpoint,
        ask: Ask,
        clock: Clock,
        *,
        max_clients: int = 16,
        in_flight: int = 16,
        admits: Callable[[str], bool] = lambda address: True,
        keep_trying: bool = True,
        idle_s: float = 0.0,
        listen: Listen = TcpListener.open,
        refused: Refused = _ignore,
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
        self._keep_trying = keep_trying
        self._idle_s = idle_s
        self._listen = listen
        self._refused = refused

    @property
    def bound(self) -> Endpoint | None:
        """Return the endpoint on which the server listens, with the actual port; None while it does not listen."""
        return self.listener.bound if self.listener is not None else None

    async def run(self) -> None:
        """Open the port, with repeated attempts, and serve until cancelled."""
        backoff = Backoff(0.25, 5.0)
        while self.listener is None:
            try:
                self.listener = await self._listen(
                    self.endpoint, self._serve, self._max_clients, self._admits, self._idle_s
                )
            except Unreachable as e:
                if not self._keep_trying:
                    raise
                self.error = str(e)
                await self._clock.sleep_until_ns(self._clock.monotonic_ns() + int(backoff.next_s() * NS_PER_S))
        self.error = ""
        try:
            await asyncio.get_running_loop().create_future()  # until cancelled
        finally:
            await self.listener.aclose()
            self.listener = None

    def status(self) -> FrontStatus:
        """Return where the server listens, its clients and its counters."""
        listener = self.listener
        return FrontStatus(
            listening=str(listener.bound) if listener is not None else None,
            error=self.error,
            clients=[f"{x.peer}:{x.peer_port}" for x in listener.clients] if listener is not None else [],
            counters={
                "accepted": listener.accepted if listener is not None else 0,
                "evicted": listener.evicted if listener is not None else 0,
                "turned_away": listener.refused if listener is not None else 0,
                "unshaken": listener.unshaken if listener is not None else 0,
                "retired": listener.retired if listener is not None else 0,
                **asdict(self.counters),
            },
        )

    async def _serve(self, connection: Client) -> None:
        session = _Session(connection, self._ask, self._refused, self._in_flight, self.counters, self._clock)
        await session.run()


class _Session:
    """The session of one client."""

    def __init__(
        self,
        connection: Client,
        ask: Ask,
        refused: Refused,
        in_flight: int,
        counters: FrontCounters,
        clock: Clock,
    ) -> None:
        self._connection = connection
        self._clock = clock
        self._caller = Caller(f"{connection.peer}:{connection.peer_port}", connection.peer, connection.role)
        self._ask = ask
        self._refused = refused
        self._in_flight = in_flight
        self._counters = counters
        self._waiting: deque[tuple[TcpRequest, Answer]] = deque()
        self._news = asyncio.Event()
        self._room = asyncio.Event()

    async def run(self) -> None:
        """Serve until the client disconnects (`ConnectionLost`), its stream cannot be parsed, or a request takes too long to
        arrive.
        """
        stream = MbapRequests()
        try:
            async with Nursery() as nursery:
                writer = nursery.start(self._write(), "answers")
                try:
                    begun_ns: int | None = None
                    while not stream.desync:
                        data = await self._read(begun_ns)
                        if data is None:
                            self._counters.unfinished += 1
                            return
                        foreign, requests = stream.foreign, stream.feed(data)
                        for request in requests:
                            await self._take(request, writer)
                        self._counters.foreign += stream.foreign - foreign
                        if not stream.unfinished:
                            begun_ns = None
                        elif begun_ns is None or requests:
                            begun_ns = self._clock.monotonic_ns()
                    self._counters.desyncs += 1
                except ConnectionLost:
                    await self._answer_the_rest(writer)
                    raise
        finally:
            for _, answer in self._waiting:
                if isinstance(answer, asyncio.Future):
                    answer.cancel()

    async def _read(self, begun_ns: int | None) -> bytes | None:
        """Return the next bytes of the client; None if the request that began at `begun_ns` is not complete in time."""
        if begun_ns is None:
            return await self._connection.read()
        while (left_s := REQUEST_WITHIN_S - (self._clock.monotonic_ns() - begun_ns) / NS_PER_S) > 0:
            if data := await self._connection.read_within(left_s):
                return data
        return None

    async def _answer_the_rest(self, writer: asyncio.Task[None]) -> None:
        """Send the outstanding answers to a client that closed its own direction and may still wait for them.

        A client that closed both directions looks the same until something is sent to it. So at most the present request and the
        next one are carried out although no client reads their answers.
        """
        while self._waiting and self._connection.lost is None and not writer.done():
            self._room.clear()
            await self._room.wait()

    async def _take(self, request: TcpRequest, writer: asyncio.Task[None]) -> None:
        while len(self._waiting) >= MOST_UNSENT and not writer.done():
            self._room.clear()
            await self._room.wait()
        self._counters.requests += 1
        answer: Answer
        if sum(isinstance(a, asyncio.Future) and not a.done() for _, a in self._waiting) >= self._in_flight:
            self._counters.busy += 1
            why = f"the client has {self._in_flight} requests without an answer"
            self._refused(self._caller, request.unit, request.pdu, SERVER_BUSY, why)
            answer = exception_pdu(refusal(request.pdu[0], SERVER_BUSY))
        else:
            answer = self._ask(self._caller, request.unit, request.pdu)
        self._waiting.append((request, answer))
        self._news.set()

    async def _write(self) -> None:
        """Send the answers, in the order of the requests (case MB-052)."""
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
