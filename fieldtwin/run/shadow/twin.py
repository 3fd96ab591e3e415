"""A running digital twin: a digital shadow that also commands the plant. Its commands form a log, which the digital
thread delivers to the plant.

If configured, the twin first queries a prototype in a separate process (`fieldtwin.run.what_if.asking`).
"""

from __future__ import annotations

import secrets
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import msgspec

from fieldtwin.gateway.core.clock import NS_PER_MS
from fieldtwin.gateway.core.concurrency.events import Consumer
from fieldtwin.gateway.core.concurrency.nursery import Nursery
from fieldtwin.gateway.core.values import COMMAND
from fieldtwin.gateway.store.event import Event, Kind, KnowledgeStore
from fieldtwin.run.shadow.shadow import STALE_AFTER_MS, Shadowing
from fieldtwin.run.shadow.status import CommandCounts, TwinStatus
from fieldtwin.run.what_if.asking import Asking
from fieldtwin.twin.model.knowledge import KnowledgeWriter
from fieldtwin.twin.model.mape.execute import CommandLimits
from fieldtwin.twin.model.mape.messages import AnalysisFinding
from fieldtwin.twin.model.mape.plan import OLD_MS, Planner
from fieldtwin.twin.model.mape.what_if import Question
from fieldtwin.twin.model.twin import DigitalTwin
from fieldtwin.twin.model.variables import Limits
from fieldtwin.twin.plant.declared import declared_variables
from fieldtwin.twin.plant.instance import Instance
from fieldtwin.twin.site.system import System
from fieldtwin.twin.thread.end import ThreadEnd
from fieldtwin.twin.thread.link import Carrier
from fieldtwin.twin.thread.thread import DTtoPTConnection, Operator, schema_of


class Twinning(Shadowing):
    """A `Shadowing` with a planner.

    `on_command` is called with each command that is sent, `on_refusal` with the reason why one is refused, here or at
    the plant. `limits` replace those of the profiles. With `asking`, a prototype is queried before each command, with
    `question` or the planner's own.
    """

    kind = "twin"
    shadow: DigitalTwin

    def __init__(
        self,
        system: System,
        place: str,
        instance: Instance,
        *,
        store: str = "",
        on_verdict: Callable[[AnalysisFinding], None],
        on_command: Callable[[COMMAND], None],
        on_refusal: Callable[[str], None] = lambda why: None,
        planner: Planner,
        limits: Mapping[str, Limits] | None = None,
        asking: Asking | None = None,
        question: Question | None = None,
    ) -> None:
        self._planner = planner
        self._limits = limits
        self._asking = asking
        self._question = question
        super().__init__(system, place, instance, store=store, on_verdict=on_verdict)
        self._on_command = on_command
        self._on_refusal = on_refusal
        self.refused_by_plant = 0
        self._by_hand: list[COMMAND] = []
        self._operator = Operator("twin", self.clock)
        self._sent: Consumer[COMMAND] = Consumer(self.shadow.execute.transmitter.event)
        self.shadow.execute.transmitter.subscribe(self._sent)
        self._way_back: DTtoPTConnection | None = None
        self._commands: KnowledgeWriter | None = None

    def _make(self, system: System) -> DigitalTwin:
        least_s, most_s = system.commands.period_s
        return DigitalTwin(
            self.receiving, self.clock, self._planner,
            declared=declared_variables(system, self._limits), stale_after_ms=STALE_AFTER_MS,
            bounds=CommandLimits(least_s, most_s, system.commands.per_minute), what_if=self._asking, question=self._question,
        )  # fmt: skip

    async def _thread(self, store: KnowledgeStore, carrier: Carrier) -> ThreadEnd:
        name = self._system.name
        origin = await store.own("twin", system=name, prototype=False, log=secrets.token_hex(4))
        end = ThreadEnd(
            store, carrier, schema_of(self._system), self.clock, origin=origin, on_events=self._arrived, insists=False
        )
        self._commands = KnowledgeWriter(store, origin, self.clock, on_written=end.appended)
        self._way_back = DTtoPTConnection(end, [self._operator], self._commands, self.clock)
        return end

    def plan(self, command: COMMAND) -> None:
        """Add a command that the user gives. It is handled like a planner's command, after the first event of the plant."""
        self._by_hand.append(command)

    async def _arrived(self, origin: str, events: Sequence[Event]) -> None:
        if self._asking is not None:
            self._asking.known.take(events)
        for event in events:
            if event.kind == Kind.REFUSAL:
                self.refused_by_plant += 1
                self.shadow.decisions.refused_by_plant(str(event.value), event.t_ms)
                if self.clock.utc_ns() // NS_PER_MS - event.t_ms <= OLD_MS:
                    self._on_refusal(f"by the plant: {event.value!s}")
        await super()._arrived(origin, events)

    async def _beside(self, nursery: Nursery, store: KnowledgeStore) -> None:
        if self._asking is not None:
            await self._asking.recall(store, [self._recalled] if self._recalled else [])
            nursery.start(self._asking.run(), "what if")

    def _step(self, writer: KnowledgeWriter) -> None:
        if self.origins:
            self._plan_by_hand()
        super()._step(writer)

    def _plan_by_hand(self) -> None:
        for command in self._by_hand:
            self.shadow.decisions.planned(command, self.clock.utc_ns() // NS_PER_MS, None)
            self.shadow.execute.plans.observe(command)
        self._by_hand.clear()

    def _give_up(self) -> None:
        if self._by_hand:
            self._plan_by_hand()
            self.shadow.execute.give_up("the twin ended before it received a status of the plant")
        self.shadow.execute.give_up("the twin ended before the simulation had a result")

    def _kept(self, event: Event) -> None:
        if event.kind == Kind.REFUSAL:
            self._on_refusal(str(event.value))

    async def _flush(self) -> None:
        for command in self._sent.drain():
            self._operator.command(command)
            self._on_command(command)
        if self._way_back is not None and self._commands is not None:
            self._way_back.pump()
            await self._commands.try_to_flush()  # a command that is not on record is not sent

    def _store_trouble(self, writer: KnowledgeWriter) -> str:
        return writer.trouble or (self._commands.trouble if self._commands is not None else "")

    def status(self) -> TwinStatus:
        execute = self.shadow.execute
        counts = CommandCounts(
            planned=self.shadow.plan.planned,
            simulated=execute.asked,
            sent=execute.sent,
            refused=execute.refused,
            refused_by_plant=self.refused_by_plant,
            unconfirmed=self._end.waiting if self._end is not None else 0,
        )
        return msgspec.structs.replace(super().status(), commands=counts)

    def describe(self) -> dict[str, Any]:
        waiting = self._end.waiting if self._end is not None else 0
        return {**super().describe(), "unconfirmed_commands": waiting, "refused_by_plant": self.refused_by_plant}
