"""One side of a thread: a store, a carrier, and the protocol core between them, for as long as the twin runs.

It opens a new link whenever one is lost, sends events from the store to the other side, stores the events that it receives,
and passes new ones on in order. This class can send; a shadow is given the received events only (paper.md, ruling 16).
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Sequence
from contextlib import suppress

from fieldtwin.gateway.core.clock import NS_PER_MS, NS_PER_S, Clock
from fieldtwin.gateway.core.concurrency.nursery import Nursery
from fieldtwin.gateway.core.errors import FieldtwinError, Unreachable
from fieldtwin.gateway.store.event import Event, KnowledgeStore, without
from fieldtwin.twin.thread.frames import Ack, Ask, Data, Frame, Hello, Lost, Refused, Schema
from fieldtwin.twin.thread.incoming import Effect, IncomingLogs, Keep, NoteLost, Open
from fieldtwin.twin.thread.link import Carrier, Link, Unwelcome
from fieldtwin.twin.thread.outgoing import OutgoingLog
from fieldtwin.twin.thread.status import ReceivedLog, ThreadStatus

FIRST_RETRY_NS, LAST_RETRY_NS = 200 * NS_PER_MS, 10 * NS_PER_S
PROVEN_NS = 5 * NS_PER_S
"""A link that lasts this long counts as good. If two digital twins connect to the same address of a thread, each displaces the
other after about this time.
"""
READ_BLOCK = 1000
STORE_PAUSE_NS = NS_PER_S

OnEvents = Callable[[str, Sequence[Event]], Awaitable[None]]
"""Called with (origin, events) in the order of their numbers. Each event is passed on once, unless the process dies
between storing it and passing it on.
"""


class ThreadEnd:
    """One side of a thread. Create it as ``ThreadEnd(store, carrier, schema, clock, origin=...)`` and call `run`, which
    continues until cancelled.

    `origin` is the log that this side sends (`KnowledgeStore.own`), empty for a side that only receives. Call
    `appended` when the log has grown. Without `insists`, `run` ends if the other side refuses this one before a link
    was ever established.
    """

    def __init__(
        self,
        store: KnowledgeStore,
        carrier: Carrier,
        schema: Schema,
        clock: Clock,
        *,
        origin: str = "",
        prototype: bool = False,
        on_events: OnEvents | None = None,
        insists: bool = True,
    ) -> None:
        self.out: OutgoingLog | None = None
        self.into = IncomingLogs(self._knows, 0)
        self.connected = False
        self.links = 0
        self.trouble = ""
        """The reason why no frames are exchanged now, or the problem that the other side reported; empty if there is no
        problem.
        """
        self._refused_by_store = ""
        """The reason why this side's store refused the last request."""
        self._store = store
        self._carrier = carrier
        self._schema = schema
        self._clock = clock
        self._origin = origin
        self._prototype = prototype
        self._on_events = on_events
        self._insists = insists
        self.silent = "there was no link"
        """A possible reason why nothing was ever received; empty as soon as anything was received."""
        self._link: Link | None = None
        self._news = asyncio.Event()
        self._told: dict[str, int] = {}
        self._lost: dict[str, int] = {}
        self._since_ms: int | None = None

    def _knows(self, schema: bytes) -> bool:
        return self._link is not None and self._link.knows(schema)

    def _fit(self, tag: bytes, events: Sequence[Event]) -> int:
        return self._link.fit(tag, events) if self._link is not None else 1

    @property
    def waiting(self) -> int:
        """Return the number of events of this side's log that the other side has not confirmed."""
        return self.out.waiting if self.out is not None else 0

    def appended(self, last: int) -> None:
        """Note that this side's log has grown to number `last`."""
        if self.out is not None:
            self.out.appended(last)
            self._news.set()

    async def make_room(self) -> int:
        """When this side's store is full, delete the older half of the events that the other side has confirmed.

        Return the number of events.
        """
        if self.out is None:
            return 0
        first, _ = await self._store.span(self._origin)
        if first > self.out.through:
            return 0
        return await self._store.forget(self._origin, first + (self.out.through - first) // 2)

    async def run(self) -> None:
        """Exchange events with the other side until cancelled, and open a new link whenever one is lost. Raises
        `FieldtwinError` only if the store cannot be read at the start, and `Unwelcome`.
        """
        if self._origin:
            first, last = await self._store.span(self._origin)
            self.out = OutgoingLog(self._origin, self._schema.id, first, last, prototype=self._prototype, fit=self._fit)
        retry_ns, opened_ns = FIRST_RETRY_NS, 0
        self._since_ms = self._utc_ms()
        while True:
            try:
                self._link = await self._carrier.open()
                opened_ns = self._clock.monotonic_ns()
                await self._converse(self._link)
            except Unreachable as e:
                self.trouble = str(e)
                if isinstance(e, Unwelcome) and not self._insists and not self.links:
                    raise
            finally:
                if self.connected:
                    self._since_ms = self._utc_ms()
                self.connected = False
                if self._link is not None:
                    self.trouble = self.trouble or self._link.trouble
                    await self._link.aclose()
                    self._link = None
                    if self._clock.monotonic_ns() - opened_ns >= PROVEN_NS:
                        retry_ns = FIRST_RETRY_NS
            await self._clock.sleep_until_ns(self._clock.monotonic_ns() + retry_ns)
            retry_ns = min(2 * retry_ns, LAST_RETRY_NS)

    async def _converse(self, link: Link) -> None:
        self.connected = True
        self._since_ms = self._utc_ms()
        self.links += 1
        self.trouble = ""
        self.silent = self.silent and link.quiet
        self.into.ack_delay_ns = link.ack_delay_ns
        if self.out is not None:
            self.out.linger_ns = link.linger_ns
            self.out.connected(self._clock.monotonic_ns())
        async with Nursery() as nursery:
            nursery.start(self._listen(link), f"{self._carrier.name}: incoming")
            nursery.start(self._talk(link), f"{self._carrier.name}: outgoing")
            await nursery.wait()

    def _utc_ms(self) -> int:
        return self._clock.utc_ns() // NS_PER_MS

    # -- what goes --------------------------------------------------------------------------------------------------------

    async def _talk(self, link: Link) -> None:
        while True:
            self._news.clear()
            if self.out is not None and (wanted := self.out.wanted()) is not None:
                await self._load(self.out, *wanted)
            now_ns = self._clock.monotonic_ns()
            frame = self.into.next_frame(now_ns) or (self.out.next_frame(now_ns) if self.out is not None else None)
            if frame is not None:
                await link.send(frame)
            else:
                await self._wait(now_ns)

    async def _load(self, out: OutgoingLog, first: int, count: int) -> None:
        try:
            out.load(first, await self._store.read(out.origin, first, count))
            self._refused_by_store = ""
        except Unreachable as e:
            self._refused_by_store = str(e)
            await self._clock.sleep_until_ns(self._clock.monotonic_ns() + STORE_PAUSE_NS)

    async def _wait(self, now_ns: int) -> None:
        """Wait until a frame arrives or has to be sent."""
        times = [self.into.wake_ns(now_ns), self.out.wake_ns(now_ns) if self.out is not None else None]
        due = min((t for t in times if t is not None), default=None)
        timeout_s = None if due is None else max(0.001, (due - now_ns) / NS_PER_S)
        with suppress(TimeoutError):
            async with asyncio.timeout(timeout_s):
                await self._news.wait()

    # -- what comes -------------------------------------------------------------------------------------------------------

    async def _listen(self, link: Link) -> None:
        while True:
            frame = await link.receive()
            self.silent = ""
            try:
                await self._take(frame)
                self._refused_by_store = ""
            # The store failed. Events that it did not store are not acknowledged, so the other side sends them again.
            except Unreachable as e:
                self._refused_by_store = str(e)
                await self._clock.sleep_until_ns(self._clock.monotonic_ns() + STORE_PAUSE_NS)
            self._news.set()

    async def _take(self, frame: Frame) -> None:
        now_ns, out = self._clock.monotonic_ns(), self.out
        if isinstance(frame, Hello | Data | Lost):
            await self._do(self.into.receive(frame, now_ns))
            if self.into.unknown_schema:
                self.trouble = (
                    f"the other side uses a schema that this one does not have: {self.into.unknown_schema.hex()}"
                    " (another system, or another version of its file)"
                )
        elif out is not None and frame.tag == out.tag:
            if isinstance(frame, Ack):
                out.on_ack(frame, now_ns)
                if out.contradicted:
                    self.trouble = f"the other side has more of {out.origin} than its own store: was a backup restored?"
            elif isinstance(frame, Ask):
                out.on_ask(now_ns)
            elif isinstance(frame, Refused):
                out.on_refused(now_ns)
                self.trouble = (
                    f"the other side does not have our schema {frame.schema.hex()} (another system, or another version of its"
                    " file); nothing is lost meanwhile"
                )

    async def _do(self, effects: list[Effect]) -> None:
        for effect in effects:
            if isinstance(effect, Open):
                await self._open(effect.origin)
            elif isinstance(effect, Keep):
                await self._keep(effect)
            elif isinstance(effect, NoteLost):
                await self._note_lost(effect)
            await self._pass_on(effect.origin)

    async def _open(self, origin: str) -> None:
        _, last = await self._store.span(origin)
        more = self.into.opened(origin, last, await self._store.gaps(origin), self._clock.monotonic_ns())
        self._told.setdefault(origin, self.into.through(origin))
        await self._do(more)

    async def _keep(self, effect: Keep) -> None:
        try:
            await self._store.keep(effect.origin, effect.events, system=self._schema.system, prototype=effect.prototype)
        except FieldtwinError:
            self.into.not_kept(effect.origin, effect.events)
            raise
        self.into.kept(effect.origin, effect.events, self._clock.monotonic_ns())

    async def _note_lost(self, effect: NoteLost) -> None:
        gaps = await self._store.gaps(effect.origin)
        last = (await self._store.span(effect.origin))[1]
        missing = [*gaps, (last + 1, max(last + 1, effect.last))]
        for first, end in without([(effect.first, effect.last)], without([(1, effect.last)], missing)):
            await self._store.note_lost(effect.origin, first, end)
            self._lost[effect.origin] = self._lost.get(effect.origin, 0) + end - first + 1
        self.into.noted(effect.origin, effect.first, effect.last, self._clock.monotonic_ns())

    async def _pass_on(self, origin: str) -> None:
        """Pass on the next events in order, without gaps except for lost events."""
        through = self.into.through(origin)
        while self._on_events is not None and (told := self._told.get(origin, through)) < through:
            block = [e for e in await self._store.read(origin, told + 1, READ_BLOCK) if e.sequence <= through]
            self._told[origin] = block[-1].sequence if block else through
            if block:
                await self._on_events(origin, block)

    def status(self) -> ThreadStatus:
        """Return the state of the thread, for a status or a summary."""
        return ThreadStatus(
            carrier=self._carrier.name,
            connected=self.connected,
            since_ms=self._since_ms,
            links=self.links,
            origin=self._origin,
            sent_through=self.out.through if self.out is not None else None,
            waiting=self.waiting,
            resent=self.out.resent if self.out is not None else 0,
            duplicates=self.into.duplicates,
            received={
                origin: ReceivedLog(through=self.into.through(origin), lost=self._lost.get(origin, 0))
                for origin in self._told
            },
            silent=self.silent,
            trouble=self._refused_by_store or self.trouble or (self._link.trouble if self._link is not None else ""),
        )
