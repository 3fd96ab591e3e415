"""Plan: the third stage. What was found becomes a command, by rules or by a planner that somebody wrote in Python.

It decides and sends nothing: what it emits goes to Execute, which asks the digital model first.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Protocol

from fieldtwin.gateway.core.clock import NS_PER_MS, Clock
from fieldtwin.gateway.core.errors import FieldtwinError
from fieldtwin.gateway.core.events import Consumer, Producer
from fieldtwin.gateway.core.statemachine import encode_period
from fieldtwin.gateway.core.values import COMMAND, DATA
from fieldtwin.gateway.store.event import Kind
from fieldtwin.twin.model.mape.messages import Verdict
from fieldtwin.twin.model.mape.what_if import PlannedCommand, Question
from fieldtwin.twin.model.model import DigitalModel
from fieldtwin.twin.model.thread_process import DTDigitalThreadProcess

CAPACITY = 1000
OLD_MS = 10_000
"""What was so longer ago is history, backfilled: nothing is planned because of it."""


_ABOUT = {
    **dict.fromkeys(("agree", "mismatch", "unreadable"), "status"),
    **dict.fromkeys(("inside", "outside"), "limits"),
    **dict.fromkeys(("good", "bad"), "quality"),
    **dict.fromkeys(("fresh", "stale"), "age"),
}
"""What a finding is about: of one subject the newer one says how it is now."""


class Planner(Protocol):
    """Planning: DATA to COMMAND; None: there is nothing to do about it. A `FieldtwinError` it raises is kept as a refusal."""

    def plan(self, data: DATA, model: DigitalModel) -> COMMAND | None: ...


@dataclass(frozen=True, slots=True)
class Rule:
    """When `finding` is told of `subject` (empty: of anything), command `period_s`.

    `ask`: what to ask a prototype first. True: what the twin asks of every command, if anything. False: nothing.
    """

    finding: str
    subject: str
    period_s: int
    ask: Question | bool = True

    def command(self) -> COMMAND:
        """What it commands."""
        made = encode_period(self.period_s)
        if self.ask is True:
            return made
        return PlannedCommand(made.data, made.name, self.ask or None)


class RulePlanner:
    """The first rule that fits decides. A period that the model has already is not commanded again."""

    def __init__(self, rules: Iterable[Rule]) -> None:
        self.rules = tuple(rules)

    def plan(self, data: DATA, model: DigitalModel) -> COMMAND | None:
        if not isinstance(data, Verdict):
            return None
        for rule in self.rules:
            if rule.finding == data.finding and rule.subject in ("", data.subject):
                return rule.command() if rule.period_s != model.period_s else None
        return None


class Plan(DTDigitalThreadProcess):
    """SPEC row Plan: consume ; Planning ; emit.

    `take` consumes what was found, `plan_next` plans because of the first of it. In between findings may wait, while a prototype
    is asked about a command: `overtaken` counts those that `only_newest` did not keep, because a newer one said otherwise.
    """

    def __init__(self, model: DigitalModel, planner: Planner, clock: Clock) -> None:
        super().__init__("plan", clock)
        self.consumer: Consumer[Verdict] = Consumer("analyzed", CAPACITY)
        self.emitter: Producer[COMMAND] = Producer("planned")
        self.digital_model = model
        self.planned = self.too_old = self.overtaken = self.failed = 0
        self._planner = planner
        self._waiting: deque[Verdict] = deque()

    def take(self) -> None:
        """Consume what was found. What was so long ago is history."""
        now_ms = self._clock.utc_ns() // NS_PER_MS
        for message in self.consumer.drain():
            if now_ms - message.t_ms > OLD_MS:
                self.too_old += 1
            else:
                self._waiting.append(message)

    def only_newest(self) -> None:
        """Of what waits keep the newest of each kind and subject: by what was otherwise since then nobody plans."""
        kept: dict[tuple[str, str], Verdict] = {}
        for message in self._waiting:
            about = (message.subject, _ABOUT.get(message.finding, message.finding))
            self.overtaken += kept.pop(about, None) is not None  # and the newer one goes to the end
            kept[about] = message
        self._waiting = deque(kept.values())

    def plan_next(self) -> bool:
        """Plan because of the first finding that waits. False: none does."""
        if not self._waiting:
            return False
        try:
            command = self._planner.plan(self._waiting.popleft(), self.digital_model)
        except FieldtwinError as e:
            self.failed += 1
            self.share(Kind.REFUSAL, self.name, str(e))
            return True
        if command is not None:
            self.planned += 1
            self.emitter.emit(command)
        return True

    def plan(self) -> None:
        """Take everything and plan because of it."""
        self.take()
        while self.plan_next():
            pass
