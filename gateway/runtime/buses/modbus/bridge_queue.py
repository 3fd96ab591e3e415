"""The queue of bridge clients' requests that wait for a bus: limited in number and fair between clients.

The requests of a client that disconnected are dropped. The bus takes one request at a time, after the PLC's writes, and never two
between two polls that are due. This module is independent of the source of a request and of the device that answers it.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

from fieldtwin.gateway.core.errors import ConnectionLost, EndpointBusy, FieldtwinError, WireError
from fieldtwin.gateway.protocols.modbus.client import ModbusClient
from fieldtwin.gateway.protocols.modbus.server.analysis import ServerRequest
from fieldtwin.gateway.protocols.modbus.server.forward import Forwarded, ForwardedReply

MAX_WAIT_NS = 10_000_000_000
"""A client that has waited longer than this has given up, so its request is not sent any more."""


@dataclass(eq=False)
class BridgeRequest:
    """A request for `unit`. `attempts` is the number of attempts left; each attempt waits for its own turn.

    `done` is called once, with the reply or the error, unless `wanted` returns False because the client has disconnected.
    """

    client: str
    unit: int
    pdu: bytes
    asked: ServerRequest
    attempts: int
    queued_ns: int
    done: Callable[[ForwardedReply | FieldtwinError], None]
    wanted: Callable[[], bool]
    before: Callable[[], None] = lambda: None
    """A function that is called just before each attempt is sent. An error that it raises ends the request."""
    deferred: bool = False


@dataclass
class BridgeQueueCounters:
    """Counters of requests that were not carried out on one bus.

    `full`: the queue was full; `gone`: the client had disconnected; `stale`: the request had waited too long."""

    carried: int = 0
    full: int = 0
    gone: int = 0
    stale: int = 0


@dataclass
class BridgeQueue:
    """A queue of at most `limit` requests of all clients together. Clients take turns. `on_put` wakes the bus."""

    limit: int = 64
    on_put: Callable[[], None] = lambda: None
    counters: BridgeQueueCounters = field(default_factory=BridgeQueueCounters)
    _waiting: dict[str, deque[BridgeRequest]] = field(default_factory=dict)
    size: int = 0
    """The number of requests that wait."""

    def put(self, guest: BridgeRequest) -> None:
        """Queue a request. If the queue is full, the request fails at once with `EndpointBusy`."""
        if self.size >= self.limit:
            self._drop_gone()
        if self.size >= self.limit:
            self.counters.full += 1
            guest.done(EndpointBusy("the bus has no room for another request", got=f"{self.size} waiting"))
            return
        self._waiting.setdefault(guest.client, deque()).append(guest)
        self.size += 1
        self.on_put()

    def take(self, now_ns: int) -> BridgeRequest | None:
        """Return the next request to carry out, from the client whose turn it is."""
        while self._waiting:
            client, line = next(iter(self._waiting.items()))
            guest = line.popleft()
            self.size -= 1
            del self._waiting[client]
            if line:
                self._waiting[client] = line  # move the client to the end, so that the other clients come first
            if not guest.wanted():
                self.counters.gone += 1
            elif now_ns - guest.queued_ns > MAX_WAIT_NS:
                self.counters.stale += 1
                guest.done(EndpointBusy("waited too long for the bus"))
            else:
                return guest
        return None

    async def carry_out(self, guest: BridgeRequest, client: ModbusClient, on_line: bool) -> None:
        """Carry out one attempt of the request `guest`. Raises only `ConnectionLost`.

        A request without a valid reply is queued again while attempts are left.
        """
        guest.attempts -= 1
        request = Forwarded(guest.unit, guest.pdu, guest.asked, on_line=on_line)
        sent_before = client.counters.requests
        try:
            guest.before()
            reply = await client.execute(guest.unit, request)
        except (WireError, ConnectionLost) as e:
            if client.counters.requests == sent_before and not guest.deferred:
                guest.deferred = True  # the connection had ended while it was idle, so the request was not sent
                guest.attempts += 1
            if guest.attempts > 0 and guest.wanted():
                self._waiting.setdefault(guest.client, deque()).appendleft(guest)
                self.size += 1
            else:
                guest.done(e)
            if isinstance(e, ConnectionLost):
                raise
        except FieldtwinError as e:
            self.counters.carried += 1
            guest.done(e)
        else:
            self.counters.carried += 1
            guest.done(reply)

    def fail_all(self, error: FieldtwinError) -> None:
        """End all requests with `error`, because the bus is down for some time."""
        while self._waiting:
            _, line = self._waiting.popitem()
            for guest in line:
                guest.done(error)
        self.size = 0

    def _drop_gone(self) -> None:
        """Make room by dropping the requests of clients that have disconnected."""
        for client, line in list(self._waiting.items()):
            kept = deque(guest for guest in line if guest.wanted())
            self.counters.gone += len(line) - len(kept)
            self.size -= len(line) - len(kept)
            if kept:
                self._waiting[client] = kept
            else:
                del self._waiting[client]
