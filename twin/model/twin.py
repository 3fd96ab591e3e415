"""The digital twin: a shadow that can also command, with Plan, Execute and a producer whose commands go to the plant.

A process of the thread (`fieldtwin.twin.thread.thread.Operator`) carries the commands that `execute.transmitter` emits.
The plant decides whether it obeys them.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from fieldtwin.gateway.core.clock import Clock
from fieldtwin.twin.model.mape.execute import CommandLimits, Execute
from fieldtwin.twin.model.mape.plan import Plan, Planner
from fieldtwin.twin.model.mape.what_if import Question, WhatIf
from fieldtwin.twin.model.shadow import DigitalShadow
from fieldtwin.twin.model.thread_process import DTDigitalThreadProcess, ReceivingEnd
from fieldtwin.twin.model.variables import ModelVariable


class DigitalTwin(DigitalShadow):
    """The paper's DigitalTwin. `step` runs Monitor, Analyze, Plan and Execute, one after the other, on what has arrived.

    While a prototype is asked about a command, the shadow continues; its findings wait in the queue of Plan.
    """

    def __init__(
        self,
        receiving: ReceivingEnd,
        clock: Clock,
        planner: Planner,
        *,
        declared: Iterable[ModelVariable],
        bounds: CommandLimits,
        stale_after_ms: int = 30_000,
        what_if: WhatIf | None = None,
        question: Question | None = None,
    ) -> None:
        super().__init__(receiving, clock, declared=declared, stale_after_ms=stale_after_ms)
        self.plan = Plan(self.digital_model, planner, clock, self.decisions)
        self.execute = Execute(
            self.digital_model, clock, bounds=bounds, what_if=what_if, question=question, decisions=self.decisions
        )
        self.analyze.emitter.subscribe(self.plan.consumer)
        self.plan.emitter.subscribe(self.execute.plans)

    @property
    def processes(self) -> tuple[DTDigitalThreadProcess, ...]:
        return (self.monitor, self.analyze, self.plan, self.execute)

    def step(self) -> int:
        count = super().step()
        self.plan.take()
        self.execute.execute()
        while not self.execute.asking and self.plan.plan_next():
            self.execute.execute()
        if self.execute.asking:
            self.plan.only_newest()
        return count

    def describe(self) -> dict[str, Any]:
        return {
            **super().describe(),
            "planned": self.plan.planned,
            "asked": self.execute.asked,
            "sent": self.execute.sent,
            "refused": self.execute.refused,
        }
