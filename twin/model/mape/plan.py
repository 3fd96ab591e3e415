"""Plan: the third stage. It turns findings into commands, by rules or by a planner that the user wrote in Python.

It only decides, and sends nothing itself: it emits commands to Execute, which checks them against the digital model before
they are sent.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Protocol

from fieldtwin.gateway.core.clock import NS_PER_MS, Clock
from fieldtwin.gateway.core.concurrency.events import Consumer, Producer
from fieldtwin.gateway.core.errors import FieldtwinError
from fieldtwin.gateway.core.statemachine import encode_period
from fieldtwin.gateway.core.values import COMMAND, DATA
from fieldtwin.gateway.store.event import Kind
from fieldtwin.twin.model.mape.decisions import DecisionLog
from fieldtwin.twin.model.mape.messages import AnalysisFinding
from fieldtwin.twin.model.mape.what_if import PlannedCommand, Question
from fieldtwin.twin.model.model import DigitalModel
from fieldtwin.twin.model.thread_process import DTDigitalThreadProcess

CAPACITY = 1000
OLD_MS = 10_000
"""A finding older than this is backfilled history: no command is planned because of it."""


_ABOUT = {
    **dict.fromkeys(("agree", "mismatch", "unreadable"), "status"),
    **dict.fromkeys(("inside", "outside"), "limits"),
    **dict.fromkeys(("good", "bad"), "quality"),
    **dict.fromkeys(("fresh", "stale"), "age"),
}
"""The property that a finding is about. For the same subject and property, a newer finding supersedes an older one."""


class Planner(Protocol):
    """The paper's Planning: a function from DATA to a COMMAND, or None if no command is needed.

    A `FieldtwinError` that it raises is recorded as a refusal.
    """

    def plan(self, data: DATA, model: DigitalModel) -> COMMAND | None: ...


@dataclass(frozen=True, slots=True)
class PlanRule:
    """A rule: when `finding` is reported for `subject` (empty: for any subject), command `period_s`.

    `ask` is the question for a prototype before the command is sent. True stands for the twin's default question, if there is
    one, and False for no question.
    """

    finding: str
    subject: str
    period_s: int
    ask: Question | bool = True

    def command(self) -> COMMAND:
        """Return the command of this rule."""
        made = encode_period(self.period_s)
        if self.ask is True:
            return made
        return PlannedCommand(made.data, made.name, self.ask or None)


class RulePlanner:
    """A planner that applies the first rule that matches. A period that the model already has is not commanded again."""

    def __init__(self, rules: Iterable[PlanRule]) -> None:
        self.rules = tuple(rules)

    def plan(self, data: DATA, model: DigitalModel) -> COMMAND | None:
        if not isinstance(data, AnalysisFinding):
            return None
        for rule in self.rules:
            if rule.finding == data.finding and rule.subject in ("", data.subject):
                return rule.command() if rule.period_s != model.period_s else None
        return None


class Plan(DTDigitalThreadProcess):
    """The paper's Plan: consume, Planning, emit.

    `take` consumes findings, and `plan_next` plans for the first of them. Findings may wait while a prototype is asked
    about a command; `overtaken` counts the findings that `only_newest` dropped because a newer finding superseded them.
    `decisions` records what is planned.
    """

    def __init__(
        self, model: DigitalModel, planner: Planner, clock: Clock, decisions: DecisionLog | None = None
    ) -> None:
        super().__init__("plan", clock)
        self.decisions = decisions or DecisionLog()
        self.consumer: Consumer[AnalysisFinding] = Consumer("analyzed", CAPACITY)
        self.emitter: Producer[COMMAND] = Producer("planned")
        self.digital_model = model
        self.planned = self.too_old = self.overtaken = self.failed = 0
        self._planner = planner
        self._waiting: deque[AnalysisFinding] = deque()

    def take(self) -> None:
        """Consume findings. Findings older than `OLD_MS` are counted and dropped."""
        now_ms = self._clock.utc_ns() // NS_PER_MS
        for message in self.consumer.drain():
            if now_ms - message.t_ms > OLD_MS:
                self.too_old += 1
                self.decisions.observed(message, "older than 10 s when it arrived, so nothing is planned for it")
            else:
                self._waiting.append(message)

    def only_newest(self) -> None:
        """Keep only the newest waiting finding of each subject and property, so that no command is planned for an outdated
        finding.
        """
        kept: dict[tuple[str, str], AnalysisFinding] = {}
        for message in self._waiting:
            about = (message.subject, _ABOUT.get(message.finding, message.finding))
            self.overtaken += kept.pop(about, None) is not None  # and move the newer one to the end
            kept[about] = message
        self._waiting = deque(kept.values())

    def plan_next(self) -> bool:
        """Plan for the first waiting finding. Return False if none is waiting."""
        if not self._waiting:
            return False
        finding = self._waiting.popleft()
        try:
            command = self._planner.plan(finding, self.digital_model)
        except FieldtwinError as e:
            self.failed += 1
            self.decisions.failed(finding, str(e), self._clock.utc_ns() // NS_PER_MS)
            self.share(Kind.REFUSAL, self.name, str(e))
            return True
        if command is not None:
            self.planned += 1
            self.decisions.planned(command, self._clock.utc_ns() // NS_PER_MS, finding)
            self.emitter.emit(command)
        return True

    def plan(self) -> None:
        """Consume all findings and plan for each of them."""
        self.take()
        while self.plan_next():
            pass
