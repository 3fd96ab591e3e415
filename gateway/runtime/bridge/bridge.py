"""The bridge: it forwards a client's request to the addressed unit, and returns that unit's answer.

Modbus TCP clients reach units on serial lines; a client on a serial line reaches units on TCP. A request is answered with a
single exception 0A if its unit ID has no route, and with a single 0B if the unit does not answer (TG 4.4.2.5). The request goes
through the target bus's own queue, after the PLC's writes and alternating with the bus's polls. After a unit did not answer, the
bridge sends it no requests for a time that grows with each failure. Meanwhile clients that address the unit get 0B immediately
(case MB-062). Every write is recorded in the audit log before it is sent.
"""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field

from fieldtwin.gateway.connections.sockets.listeners import TcpListener
from fieldtwin.gateway.core.clock import NS_PER_S, Clock
from fieldtwin.gateway.core.connection import Connector, Listen
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import (
    EndpointBusy,
    FieldtwinError,
    ModbusExceptionReply,
    ReplyTimeout,
    Unreachable,
    UsageError,
    VerifyFailed,
    WireError,
)
from fieldtwin.gateway.protocols.modbus.frames.selection import framing_of
from fieldtwin.gateway.protocols.modbus.requests.refusals import refusal
from fieldtwin.gateway.protocols.modbus.server.analysis import (
    BROADCAST_FUNCTIONS,
    ILLEGAL_FUNCTION,
    NO_PATH,
    NO_RESPONSE,
    SERVER_BUSY,
    SERVER_FAILURE,
    ServerRequest,
    changes_a_unit,
    examine,
    exception_pdu,
)
from fieldtwin.gateway.protocols.modbus.server.forward import ForwardedReply
from fieldtwin.gateway.runtime.audit_log import AuditLog
from fieldtwin.gateway.runtime.bridge.audit import WriteRecord
from fieldtwin.gateway.runtime.bridge.broadcast import when_all_are_out
from fieldtwin.gateway.runtime.bridge.cache import ReplyCache
from fieldtwin.gateway.runtime.bridge.line import LineFront
from fieldtwin.gateway.runtime.bridge.policy import Policy
from fieldtwin.gateway.runtime.bridge.tcp import Answer, Caller, TcpFront
from fieldtwin.gateway.runtime.buses.backoff import Backoff
from fieldtwin.gateway.runtime.buses.modbus.bridge_queue import BridgeRequest
from fieldtwin.gateway.runtime.buses.modbus.modbus_bus import ModbusBus
from fieldtwin.gateway.runtime.gateway_status import BridgeStatus

_FULL = "too many requests wait for the bus"
LAST_LINE_UNIT = 247
"""Unit IDs 248 to 255 are reserved on a serial line (SL 2.2)."""


@dataclass(frozen=True, slots=True)
class Route:
    """The target of a client's unit ID: a bus, and the unit ID on it."""

    bus: str
    unit: int


@dataclass(frozen=True)
class BridgeConfig:
    """One bridge. `listen` is ``tcp://HOST:PORT`` or ``tls://HOST:PORT`` for clients, or a serial line whose client
    sends requests to the gateway.

    `routes` are searched first; a unit ID that is not in them keeps its ID on the bus `to`, if that is given. With `broadcast`,
    unit ID 0 is forwarded to every serial line that the bridge reaches, and no unit answers; with `answer_broadcast` the bridge
    answers when the broadcast was sent. `queue` limits the requests that wait for one bus, `in_flight` the unanswered requests of
    one client. `cache_ms` is the longest age of a cached reply; 0: no cache. A client that is silent for `idle_s` is
    disconnected; 0: never.
    """

    name: str
    listen: Endpoint
    to: str | None = None
    routes: Mapping[int, Route] = field(default_factory=dict)
    policy: Policy = field(default_factory=Policy)
    broadcast: bool = False
    answer_broadcast: bool = False
    cache_ms: int = 0
    clients: int = 16
    queue: int = 32
    in_flight: int = 16
    idle_s: float = 0.0
    keep_trying: bool = True
    """Whether the bridge repeats its attempts if its port cannot be opened. Otherwise the first failure is an error."""

    @property
    def buses(self) -> set[str]:
        """Return the names of the buses to which the bridge forwards."""
        return {r.bus for r in self.routes.values()} | ({self.to} if self.to else set())


@dataclass
class BridgeCounters:
    """Counters of the outcomes of requests.

    Requests in `no_path` and `refused` were not forwarded. Those in `spared` and `full` were answered without using the bus:
    `spared` because the unit had not answered before, `full` because the queue was full. Those in `silent` got no answer from the
    unit, and those in `unread` were answered after the client had disconnected.
    """

    requests: int = 0
    no_path: int = 0
    refused: int = 0
    spared: int = 0
    full: int = 0
    silent: int = 0
    unread: int = 0
    broadcasts: int = 0


@dataclass
class _Away:
    """The state of a unit that did not answer: its back-off, and the end of the present pause."""

    backoff: Backoff = field(default_factory=lambda: Backoff(0.5, 10.0))
    until_ns: int = 0


class Bridge:
    """One bridge, which runs until cancelled.

    `buses` are those of the gateway, by name. `blocked(bus, unit)` returns the reason why a unit must not be written to, or "".
    """

    def __init__(
        self,
        config: BridgeConfig,
        buses: Mapping[str, ModbusBus],
        connector: Connector,
        clock: Clock,
        audit: AuditLog,
        blocked: Callable[[str, int], str] = lambda bus, unit: "",
        listen: Listen = TcpListener.open,
    ) -> None:
        missing = config.buses - set(buses)
        if missing:
            raise UsageError(f"bridge {config.name!r}: no Modbus bus {', '.join(sorted(missing))}")
        self.config = config
        self.counters = BridgeCounters()
        self.cache = ReplyCache(config.cache_ms)
        self._buses = {name: buses[name] for name in config.buses}
        if any(r.unit == 0 and self._is_line(r.bus) for r in config.routes.values()):
            raise UsageError(
                f"bridge {config.name!r}: unit 0 is a broadcast to all units of the line",
                hint="`broadcast` passes it on",
            )
        self._clock = clock
        self._audit = audit
        self._blocked = blocked
        self._record = WriteRecord(audit, clock)
        self._under_way: Counter[str] = Counter()
        self._away: dict[Route, _Away] = {}
        self.front: TcpFront | LineFront
        if config.listen.is_serial:
            if framing_of(config.listen) != "rtu":
                raise UsageError(f"bridge {config.name!r} supports only RTU", got=str(config.listen))
            self.front = LineFront(config.listen, connector, self.ask, self._is_ours, clock)
        else:
            self.front = TcpFront(
                config.listen,
                self.ask,
                clock,
                max_clients=config.clients,
                in_flight=config.in_flight,
                admits=config.policy.admits,
                keep_trying=config.keep_trying,
                idle_s=config.idle_s,
                listen=listen,
                refused=self._note_refusal,
            )

    async def run(self) -> None:
        """Serve clients until cancelled. The buses have to be running."""
        await self.front.run()

    def status(self) -> BridgeStatus:
        """Return where the bridge listens, its clients, its counters, and the units that get no requests for a time."""
        front, now_ns = self.front.status(), self._clock.monotonic_ns()
        return BridgeStatus(
            listening=front.listening,
            error=front.error,
            clients=front.clients,
            counters={**front.counters, **asdict(self.counters), "cache_hits": self.cache.hits},
            away=[f"{route.bus}/{route.unit}" for route, away in self._away.items() if away.until_ns > now_ns],
        )

    # -- one request ------------------------------------------------------------------------------------------------

    def ask(self, caller: Caller, unit: int, pdu: bytes) -> Answer:
        """Handle a request for `unit`, the unit ID as the client sent it. Never waits; every refusal is an exception
        response."""
        self.counters.requests += 1
        try:
            asked, route = self._checked(caller, unit, pdu)
            if route is None:
                sent = self._broadcast(caller, pdu, asked)
                return when_all_are_out(pdu, sent) if self.config.answer_broadcast else None
            return self._forward(caller, route, pdu, asked)
        except ModbusExceptionReply as e:
            self._note_refusal(caller, unit, pdu, e.code, e.hint)
            return exception_pdu(e)

    def _note_refusal(self, caller: Caller, unit: int, pdu: bytes, code: int, why: str = "") -> None:
        """Record a request that was not forwarded, if it may change a unit."""
        if changes_a_unit(pdu):
            self._record.refused(caller.on_record, self._place(unit, self._route(unit)), unit, pdu, code, why)

    def _checked(self, caller: Caller, unit: int, pdu: bytes) -> tuple[ServerRequest, Route | None]:
        """Check a client's request, and return it parsed, with its route. A route of None means a broadcast. Raises the
        exception with which the bridge answers a request that it does not forward.
        """
        function = pdu[0] if pdu else 0
        route = self._route(unit)
        broadcast = route is None and unit == 0 and self.config.broadcast
        if route is None and not broadcast:
            self.counters.no_path += 1
            raise refusal(function, NO_PATH, "the bridge has no route for this unit ID")
        try:
            asked = examine(pdu)
        except ModbusExceptionReply:
            self.counters.refused += 1
            raise
        code = self.config.policy.check(caller.address, unit, asked, caller.role)
        if broadcast and not code and asked.function not in BROADCAST_FUNCTIONS:
            code = ILLEGAL_FUNCTION
        if code:
            self.counters.refused += 1
            raise refusal(function, code, "the allow list of the bridge refuses it")
        return asked, route

    def _route(self, unit: int) -> Route | None:
        found = self.config.routes.get(unit)
        if found is not None or self.config.to is None:
            return found
        last = LAST_LINE_UNIT if self._is_line(self.config.to) else 255
        return Route(self.config.to, unit) if 1 <= unit <= last else None

    def _is_line(self, bus: str) -> bool:
        return framing_of(self._buses[bus].config.endpoint) in ("rtu", "ascii")

    def _is_ours(self, unit: int) -> bool:
        """Return whether the gateway answers for a unit ID on a shared line.

        It does so only for unit IDs with a route; the others belong to other devices (case MB-029)."""
        return self._route(unit) is not None or (unit == 0 and self.config.broadcast)

    def _place(self, unit: int, route: Route | None) -> str:
        return f"{route.bus}/{route.unit}" if route is not None else f"{self.config.name}/{unit}"

    def _forward(self, caller: Caller, route: Route, pdu: bytes, asked: ServerRequest) -> Answer:
        bus, now_ns = self._buses[route.bus], self._clock.monotonic_ns()
        kept = None if asked.changes else self.cache.get(route.bus, route.unit, pdu, now_ns)
        if kept is not None:
            return kept
        if bus.down is not None:
            raise refusal(asked.function, self._code_of(bus.down, route), str(bus.down))
        away = self._away.get(route)
        if away is not None and now_ns < away.until_ns:
            self.counters.spared += 1
            raise refusal(asked.function, NO_RESPONSE, "the unit did not answer, and is not asked for some seconds")
        if self._under_way[route.bus] >= self.config.queue:
            self.counters.full += 1
            raise refusal(asked.function, SERVER_BUSY, _FULL)
        if asked.changes and (why := self._blocked(route.bus, route.unit)):
            raise refusal(asked.function, NO_PATH, why)
        promise: asyncio.Future[bytes | None] = asyncio.get_running_loop().create_future()
        self._under_way[route.bus] += 1
        promise.add_done_callback(lambda _: self._ended(route.bus))
        attempts = 1 if asked.changes or away is not None else 1 + bus.config.retries
        bus.guests.put(self._guest(caller, route, pdu, asked, promise, attempts))
        return promise

    def _guest(
        self,
        caller: Caller,
        route: Route,
        pdu: bytes,
        asked: ServerRequest,
        promise: asyncio.Future[bytes | None],
        attempts: int,
    ) -> BridgeRequest:
        def before() -> None:
            if asked.changes:
                self._record.asked(caller.on_record, self._place(0, route), route.unit, pdu)

        def done(result: ForwardedReply | FieldtwinError) -> None:
            response = self._response(route, pdu, asked, result)
            if asked.changes:
                self.cache.forget(route.bus, route.unit)
                self._record.ended(caller.on_record, self._place(0, route), route.unit, pdu, result)
            if promise.done():
                self.counters.unread += 1
            else:
                promise.set_result(response)

        now_ns = self._clock.monotonic_ns()
        return BridgeRequest(
            caller.name, route.unit, pdu, asked, attempts, now_ns, done, lambda: not promise.done(), before
        )

    def _ended(self, bus: str) -> None:
        self._under_way[bus] -= 1

    # -- answers ----------------------------------------------------------------------------------------------------

    def _response(
        self, route: Route, pdu: bytes, asked: ServerRequest, result: ForwardedReply | FieldtwinError
    ) -> bytes | None:
        """Return the response PDU for a result, and note whether the unit answered."""
        if isinstance(result, ForwardedReply):
            self._away.pop(route, None)
            self.cache.put(route.bus, route.unit, pdu, result.raw, result.t_ns)
            return result.raw
        code = self._code_of(result, route)
        if isinstance(result, ModbusExceptionReply):
            self._away.pop(route, None)
        elif isinstance(result, ReplyTimeout):
            away = self._away.setdefault(route, _Away())
            away.until_ns = self._clock.monotonic_ns() + int(away.backoff.next_s() * NS_PER_S)
        self.counters.silent += code == NO_RESPONSE
        return exception_pdu(refusal(asked.function, code))

    def _code_of(self, error: FieldtwinError, route: Route) -> int:
        """Return the exception code for the client.

        The unit's own exception is passed on unchanged. The code is 0B if there was no valid answer, 06 if a queue was full, 0A
        if the connection of the bus is down (0B if it is TCP, because then it belongs to the unit), and 04 for any other error,
        which is a failure of the gateway.
        """
        match error:
            case ModbusExceptionReply():
                return error.code
            case EndpointBusy():
                return SERVER_BUSY if self._buses[route.bus].down is None else NO_PATH
            case Unreachable():
                return NO_PATH if self._buses[route.bus].config.endpoint.is_serial else NO_RESPONSE
            case WireError() | VerifyFailed():
                return NO_RESPONSE
            case _:
                return SERVER_FAILURE

    def _broadcast(self, caller: Caller, pdu: bytes, asked: ServerRequest) -> list[asyncio.Future[bytes | None]]:
        """Send a broadcast once to every serial line; units do not answer it (case MB-028). Return a future for each line."""
        sent = []
        for name, bus in self._buses.items():
            if not self._is_line(name):
                continue
            why = str(bus.down) if bus.down is not None else self._blocked(name, 0)
            if not why and self._under_way[name] >= self.config.queue:
                why = _FULL
            if why:
                self._record.refused(caller.on_record, f"{name}/0", 0, pdu, NO_PATH, why)
                continue
            promise: asyncio.Future[bytes | None] = asyncio.get_running_loop().create_future()
            self.counters.broadcasts += 1
            self._under_way[name] += 1
            promise.add_done_callback(lambda _, name=name: self._ended(name))  # type: ignore[misc]
            bus.guests.put(self._guest(caller, Route(name, 0), pdu, asked, promise, attempts=1))
            sent.append(promise)
        return sent
