"""A running digital shadow: the digital thread that delivers the plant's observations, the store that keeps them, and the model.

The part that sends to the plant is assembled here, outside of `fieldtwin.twin.model.shadow`
(docs/explanation/paper.md, ruling 16): it acknowledges events and requests missing ones, and has no log to send.
"""

from __future__ import annotations

import asyncio
import secrets
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import msgspec

from fieldtwin.gateway.core.clock import NS_PER_MS
from fieldtwin.gateway.core.concurrency.nursery import Nursery
from fieldtwin.gateway.core.control import ControlServer
from fieldtwin.gateway.store.event import Event, Kind, KnowledgeStore
from fieldtwin.gateway.store.knowledge import open_knowledge
from fieldtwin.gateway.wallclock import WallClock
from fieldtwin.run.shadow.status import MOST_DECISIONS, LagStatus, TwinStatus, VariableStatus
from fieldtwin.run.what_if.known import recall
from fieldtwin.twin.model.knowledge import KnowledgeWriter
from fieldtwin.twin.model.mape.messages import AnalysisFinding
from fieldtwin.twin.model.shadow import DigitalShadow
from fieldtwin.twin.model.thread_process import ReceivingEnd
from fieldtwin.twin.model.variables import Limits
from fieldtwin.twin.plant.declared import declared_variables
from fieldtwin.twin.plant.instance import Instance
from fieldtwin.twin.site.system import System
from fieldtwin.twin.thread.end import ThreadEnd
from fieldtwin.twin.thread.link import Carrier
from fieldtwin.twin.thread.place import twin_carrier
from fieldtwin.twin.thread.thread import schema_of, to_receivers

STEP_MS = 50
ABOUT_THE_PLANT = (Kind.VALUE, Kind.STATE, Kind.PAYLOAD)
STALE_AFTER_MS = 30_000
"""A tag is stale after this time in ms: three times the period in which a plant repeats unchanged values."""


def limits_of(system: System) -> dict[str, Limits]:
    """Return the limits of every tag for which its profile states limits, by DEVICE.TAG."""
    return {
        f"{d.name}.{t.name}": t.limits
        for d in system.devices.values()
        for t in d.profile.tags.values()
        if t.limits is not None
    }


class Shadowing:
    """A digital shadow of a plant: ``await Shadowing(...).run(stop)``. `on_verdict` is called with each verdict.

    While it runs it serves commands on `KIND.sock` in the run directory: ready (an event of the plant arrived and the digital
    thread is connected) and get for health checks, and status (`TwinStatus`) for programs that show it.
    """

    kind = "shadow"

    def __init__(
        self,
        system: System,
        place: str,
        instance: Instance,
        *,
        store: str = "",
        on_verdict: Callable[[AnalysisFinding], None],
    ) -> None:
        self.clock = WallClock()
        self.receiving = ReceivingEnd("from the plant")
        self.shadow = self._make(system)
        self.prototypes: set[str] = set()
        """Origins of logs whose field devices are simulated (docs/explanation/paper.md, ruling 15)."""
        self.origins: set[str] = set()
        self._system = system
        self._place = place
        self._socket = Path(instance.dir) / f"{self.kind}.sock"
        self._store = store or str(Path(instance.dir) / "knowledge.sqlite")
        self._on_verdict = on_verdict
        self.on_trouble: Callable[[str, str], None] = lambda where, text: None
        """Called with each problem of the digital thread or the store, and with an empty text when the problem is over."""
        self._troubles: dict[str, str] = {}
        self._recalled = ""
        """The origin of the stored log from which the shadow restored its knowledge at the start; empty if there was none."""
        self._end: ThreadEnd | None = None

    def _make(self, system: System) -> DigitalShadow:
        return DigitalShadow(
            self.receiving, self.clock, declared=declared_variables(system), stale_after_ms=STALE_AFTER_MS
        )

    async def _thread(self, store: KnowledgeStore, carrier: Carrier) -> ThreadEnd:
        """Return the receiving end of the digital thread; it has no log to send."""
        return ThreadEnd(store, carrier, schema_of(self._system), self.clock, on_events=self._arrived, insists=False)

    async def run(self, stop: asyncio.Event, for_s: float = 0.0) -> None:
        """Receive and analyze the plant's events until `stop`, or for `for_s` seconds. Raises `FieldtwinError` for a store
        that cannot be used.
        """
        system, clock = self._system, self.clock
        store = await open_knowledge(self._store)
        server = ControlServer({"ready": self._ready, "get": self._get, "status": self._status})
        try:
            await server.listen_unix(self._socket)
            own = await store.own("shadow", system=system.name, prototype=False, log=secrets.token_hex(4))
            carrier = twin_carrier(self._place, system, clock)
            await self._recall(store)
            self._end = await self._thread(store, carrier)
            writer = KnowledgeWriter(store, own, clock)
            try:
                async with Nursery() as nursery:
                    nursery.start(self._end.run(), "thread")
                    nursery.start(writer.run(), "knowledge")
                    nursery.start(self._work(writer), "shadow")
                    await self._beside(nursery, store)
                    ended = nursery.start(stop.wait(), "until stopped")
                    waiting = asyncio.ensure_future(nursery.wait())
                    await asyncio.wait([ended, waiting], timeout=for_s or None, return_when=asyncio.FIRST_COMPLETED)
                    if waiting.done() and not ended.done():
                        waiting.result()
                    waiting.cancel()
            finally:
                self._step(writer)
                self._give_up()
                self._share(writer)
                await writer.flush()
                await self._flush()
                kinds = await store.origins()
                self.prototypes = {origin for origin in self.origins if kinds.get(origin)}
                await carrier.aclose()
        finally:
            await server.aclose()
            await store.aclose()

    async def _recall(self, store: KnowledgeStore) -> None:
        """Restore the knowledge of this plant from the shadow's last run, from the log with the newest event only."""
        newest_ms = 0
        last: dict[tuple[int, str], Event] = {}
        for origin in await store.origins(self._system.name):
            told: dict[tuple[int, str], Event] = {}

            def take(events: Sequence[Event], told: dict[tuple[int, str], Event] = told) -> None:
                told.update({(e.kind, e.name): e for e in events if e.kind in ABOUT_THE_PLANT})

            await recall(store, origin, take)
            latest_ms = max((event.t_ms for event in told.values()), default=0)
            if latest_ms > newest_ms:
                newest_ms, last, self._recalled = latest_ms, told, origin
        self.shadow.recall(last.values())

    async def _ready(self, args: dict[str, Any]) -> dict[str, Any]:
        return {"ready": bool(self.origins) and self._end is not None and self._end.connected}

    async def _get(self, args: dict[str, Any]) -> dict[str, Any]:
        return self.describe()

    async def _status(self, args: dict[str, Any]) -> TwinStatus:
        return self.status()

    async def _arrived(self, origin: str, events: Sequence[Event]) -> None:
        self.origins.add(origin)
        await to_receivers(self.receiving)(origin, events)

    async def _beside(self, nursery: Nursery, store: KnowledgeStore) -> None:
        """Run a subclass's additional tasks for the lifetime of the shadow. A plain shadow has no such tasks."""

    def _give_up(self) -> None:
        """Stop a subclass's tasks without waiting for unfinished work. A plain shadow has no such tasks."""

    async def _flush(self) -> None:
        """Write and send a subclass's remaining data, after the last event. A plain shadow has none."""
        return

    async def _work(self, writer: KnowledgeWriter) -> None:
        while True:
            self._step(writer)
            await self._flush()
            self._look_for_trouble(writer)
            await self.clock.sleep_until_ns(self.clock.monotonic_ns() + STEP_MS * NS_PER_MS)

    def _look_for_trouble(self, writer: KnowledgeWriter) -> None:
        assert self._end is not None
        for where, text in (("thread", self._end.status().trouble), ("store", self._store_trouble(writer))):
            if text != self._troubles.get(where, ""):
                self._troubles[where] = text
                self.on_trouble(where, text)

    def _store_trouble(self, writer: KnowledgeWriter) -> str:
        return writer.trouble

    def _step(self, writer: KnowledgeWriter) -> None:
        self.shadow.step()
        self._share(writer)
        for verdict in self.shadow.verdicts.drain():
            self._on_verdict(verdict)

    def _share(self, writer: KnowledgeWriter) -> None:
        for process in self.shadow.processes:
            for event in process.collect():
                self._kept(event)
                writer.observe(event)

    def _kept(self, event: Event) -> None:
        """Handle an event that this shadow itself recorded, before it is stored."""

    def status(self) -> TwinStatus:
        """Return the present status, with the newest decisions."""
        shadow = self.shadow
        figures = shadow.analyze.figures()
        variables = shadow.digital_model.variables
        return TwinStatus(
            kind=self.kind,
            system=self._system.name,
            place=self._place,
            now_ms=self.clock.utc_ns() // NS_PER_MS,
            origins=sorted(self.origins),
            state=shadow.digital_model.state.name,
            period_s=shadow.digital_model.period_s,
            thread=self._end.status() if self._end is not None else None,
            store=self._store,
            store_trouble=self._troubles.get("store", ""),
            variables=msgspec.convert(variables.describe(), dict[str, VariableStatus]),
            undeclared=variables.undeclared,
            statuses=figures["statuses"],
            agreed=figures["agreed"],
            measurements=figures["measurements"],
            backfilled=figures["backfilled"],
            twinning_rate_hz=figures["twinning_rate_hz"],
            lag_ms=msgspec.convert(figures["lag_ms"], LagStatus | None),
            wrong=figures["wrong"],
            decisions=shadow.decisions.newest(MOST_DECISIONS),
            decided=shadow.decisions.count,
        )

    def describe(self) -> dict[str, Any]:
        """Return the shadow's knowledge and the status of its digital thread."""
        thread = msgspec.to_builtins(self._end.status()) if self._end is not None else {}
        return {
            "system": self._system.name,
            "prototype": bool(self.prototypes),
            "reports_state": any(device.profile.inbox is not None for device in self._system.devices.values()),
            "origins": sorted(self.origins),
            "thread": thread,
            "store_trouble": self._troubles.get("store", ""),
            **self.shadow.describe(),
        }
