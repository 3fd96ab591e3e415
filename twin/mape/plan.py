"""Plan: the third stage. What was found becomes a command, by rules or by a planner that somebody wrote in Python.

It decides and sends nothing: what it emits goes to Execute, which asks the digital model first.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Protocol

from gateway.core.clock import NS_PER_MS, Clock
from gateway.core.events import Consumer, Producer
from gateway.core.statemachine import encode_period
from gateway.core.values import COMMAND, DATA
from twin.mape.messages import Verdict
from twin.model import DigitalModel
from twin.thread_process import DTDigitalThreadProcess

CAPACITY = 1000
OLD_MS = 10_000
"""What was so longer ago is history, backfilled: nothing is planned because of it."""


class Planner(Protocol):
    """Planning: DATA to COMMAND. None: there is nothing to do about it."""

    def plan(self, data: DATA, model: DigitalModel) -> COMMAND | None: ...


@dataclass(frozen=True, slots=True)
class Rule:
    """When `finding` is told of `subject` (empty: of anything), command `period_s`."""

    finding: str
    subject: str
    period_s: int


class RulePlanner:
    """The first rule that fits decides. A period that the model has already is not commanded again."""

    def __init__(self, rules: Iterable[Rule]) -> None:
        self.rules = tuple(rules)

    def plan(self, data: DATA, model: DigitalModel) -> COMMAND | None:
        if not isinstance(data, Verdict):
            return None
        for rule in self.rules:
            if rule.finding == data.finding and rule.subject in ("", data.subject):
                return encode_period(rule.period_s) if rule.period_s != model.period_s else None
        return None


class Plan(DTDigitalThreadProcess):
    """SPEC row Plan: consume ; Planning ; emit."""

    def __init__(self, model: DigitalModel, planner: Planner, clock: Clock) -> None:
        super().__init__("plan", clock)
        self.consumer: Consumer[Verdict] = Consumer("analyzed", CAPACITY)
        self.emitter: Producer[COMMAND] = Producer("planned")
        self.digital_model = model
        self.planned = self.too_old = 0
        self._planner = planner

    def plan(self) -> None:
        now_ms = self._clock.utc_ns() // NS_PER_MS
        for message in self.consumer.drain():
            if now_ms - message.t_ms > OLD_MS:
                self.too_old += 1
                continue
            command = self._planner.plan(message, self.digital_model)
            if command is not None:
                self.planned += 1
                self.emitter.emit(command)
