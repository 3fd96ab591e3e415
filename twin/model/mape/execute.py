"""Execute: the last stage. It checks each command against the digital model, and sends only what the model accepts.

If configured, it also asks a prototype. The answer takes time, during which later commands wait in the queue and the twin
continues to run. No user is involved. A refusal becomes an event with its reason (paper.md, ruling 9).
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

from fieldtwin.gateway.core.clock import NS_PER_MS, NS_PER_S, Clock
from fieldtwin.gateway.core.concurrency.events import Consumer, Producer
from fieldtwin.gateway.core.errors import Desync
from fieldtwin.gateway.core.statemachine import PERIOD_MAX, PERIOD_MIN, decode_period
from fieldtwin.gateway.core.values import COMMAND
from fieldtwin.gateway.store.event import Kind
from fieldtwin.twin.model.mape.decisions import DecisionLog
from fieldtwin.twin.model.mape.what_if import PlannedCommand, Question, WhatIf
from fieldtwin.twin.model.model import DigitalModel
from fieldtwin.twin.model.thread_process import DTDigitalThreadProcess

CAPACITY = 1000
MINUTE_NS = 60 * NS_PER_S


@dataclass(frozen=True, slots=True)
class CommandLimits:
    """The limits of commands: periods from `least_s` to `most_s`, and the number of commands in any minute."""

    least_s: int = PERIOD_MIN
    most_s: int = PERIOD_MAX
    per_minute: int = 60


class CommandCheck:
    """The check that a command can be decoded, is inside its bounds and does not exceed the rate.

    Plant and twin each have their own check: the plant does not rely on the twin that commands it.
    """

    def __init__(self, bounds: CommandLimits, clock: Clock) -> None:
        self.bounds = bounds
        self._clock = clock
        self._taken: deque[int] = deque(maxlen=bounds.per_minute)

    def restate(self, bounds: CommandLimits) -> None:
        """Replace the limits. Commands that were accepted before still count towards the rate."""
        if bounds != self.bounds:
            self.bounds = bounds
            self._taken = deque(self._taken, maxlen=bounds.per_minute)

    def objection(self, command: COMMAND) -> str:
        """Return why the command is refused, or an empty text if it is acceptable."""
        try:
            period_s = decode_period(command)
        except Desync as e:
            return str(e)
        b, now_ns = self.bounds, self._clock.monotonic_ns()
        if not b.least_s <= period_s <= b.most_s:
            return f"a period of {period_s} s; allowed are {b.least_s} to {b.most_s} s"
        if len(self._taken) == b.per_minute and now_ns - self._taken[0] < MINUTE_NS:
            return f"more than {b.per_minute} commands in a minute"
        return ""

    def take(self) -> None:
        """Count a command towards the rate, at the present time."""
        self._taken.append(self._clock.monotonic_ns())


class Execute(DTDigitalThreadProcess):
    """The paper's Execute: consume, ChangeState, emit. `transmitter` emits the commands to send, in order.

    `what_if` answers the question of each command, by simulation; the default `question` applies if the planner gives none.
    The command is sent only after an answer without an objection. `decisions` records the outcomes.
    """

    def __init__(
        self,
        model: DigitalModel,
        clock: Clock,
        *,
        bounds: CommandLimits,
        what_if: WhatIf | None = None,
        question: Question | None = None,
        decisions: DecisionLog | None = None,
    ) -> None:
        super().__init__("execute", clock)
        self.decisions = decisions or DecisionLog()
        self.plans: Consumer[COMMAND] = Consumer("planned", CAPACITY)
        self.transmitter: Producer[COMMAND] = Producer("to the plant")
        self.digital_model = model
        self.sent = self.refused = self.asked = 0
        self._check = CommandCheck(bounds, clock)
        self._what_if = what_if
        self._question = question
        self._pending: COMMAND | None = None

    @property
    def asking(self) -> bool:
        """Return whether a command waits for the answer of a prototype; commands planned meanwhile wait in the queue."""
        return self._pending is not None

    def change_state(self, command: COMMAND) -> str:
        """Apply the command to the model (ChangeState). If it is refused, return the reason and leave the model unchanged."""
        objection = self._check.objection(command)
        if not objection:
            self.digital_model.process_event(command)
            self._check.take()
        return objection

    def execute(self) -> None:
        """Process the planned commands in order, up to the first one whose answer is still pending."""
        while self._pending is not None or self.plans.queue:
            command, objection = self._next()
            if objection is None:
                return
            self._settle(command, objection or self.change_state(command))

    def give_up(self, why: str) -> None:
        """Refuse the command that waits for an answer and all later commands, because the twin ends."""
        waiting = [*self.plans.drain()] if self._pending is None else [self._pending, *self.plans.drain()]
        self._pending = None
        for command in waiting:
            self._settle(command, why)

    def _next(self) -> tuple[COMMAND, str | None]:
        """Return the first command and the objection to it, before the model takes it; None while the answer is pending."""
        if self._pending is None:
            command = self.plans.consume()
            question = command.question if isinstance(command, PlannedCommand) else self._question
            objection = self._check.objection(command)
            if objection or question is None:
                return command, objection
            if self._what_if is None:
                return command, "a what-if simulation is required first, and this process cannot run one"
            self._pending = command
            self.asked += 1
            self.decisions.asked(command, question)
            self._what_if.ask(command, question)
        assert self._what_if is not None
        command, answer = self._pending, self._what_if.answer()
        if answer is not None:
            self._pending = None
        return command, answer

    def _settle(self, command: COMMAND, objection: str) -> None:
        self.decisions.settled(command, objection, self._clock.utc_ns() // NS_PER_MS)
        if objection:
            self.refused += 1
            self.share(Kind.REFUSAL, self.name, _with_period(command, objection))
        else:
            self.sent += 1
            self.transmitter.emit(command)


def _with_period(command: COMMAND, objection: str) -> str:
    """Return the reason with the command's period, unless the reason already contains it."""
    try:
        period_s = decode_period(command)
    except Desync:
        return objection
    return objection if objection.startswith("a period of") else f"period {period_s} s: {objection}"
