"""Execute: the last stage. A command is held against the digital model first; only what the model accepts is sent.

Where it was told to, a prototype is asked as well. That takes time, and nobody waits: the commands behind it stay in the queue.
No user steps in. A refusal is an event with its reason (SPEC ruling 9), and is kept.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

from fieldtwin.gateway.core.clock import NS_PER_S, Clock
from fieldtwin.gateway.core.errors import Desync
from fieldtwin.gateway.core.events import Consumer, Producer
from fieldtwin.gateway.core.statemachine import PERIOD_MAX, PERIOD_MIN, decode_period
from fieldtwin.gateway.core.values import COMMAND
from fieldtwin.gateway.store.event import Kind
from fieldtwin.twin.model.mape.what_if import PlannedCommand, Question, WhatIf
from fieldtwin.twin.model.model import DigitalModel
from fieldtwin.twin.model.thread_process import DTDigitalThreadProcess

CAPACITY = 1000
MINUTE_NS = 60 * NS_PER_S


@dataclass(frozen=True, slots=True)
class Bounds:
    """What may be commanded: periods from `least_s` to `most_s`, and how many commands in any minute."""

    least_s: int = PERIOD_MIN
    most_s: int = PERIOD_MAX
    per_minute: int = 60


class CommandCheck:
    """Whether a command is one, inside its bounds and not too often. Both twins have one of their own: whoever obeys does not
    rely on who commands."""

    def __init__(self, bounds: Bounds, clock: Clock) -> None:
        self.bounds = bounds
        self._clock = clock
        self._taken: deque[int] = deque(maxlen=bounds.per_minute)

    def restate(self, bounds: Bounds) -> None:
        """Other bounds from now on; what was taken before counts."""
        if bounds != self.bounds:
            self.bounds = bounds
            self._taken = deque(self._taken, maxlen=bounds.per_minute)

    def objection(self, command: COMMAND) -> str:
        """Why it is refused; empty when nothing speaks against it."""
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
        """One was taken now."""
        self._taken.append(self._clock.monotonic_ns())


class Execute(DTDigitalThreadProcess):
    """SPEC row Execute: consume ; ChangeState ; emit. `transmitter` emits what is to be sent, in order.

    `question` is what `what_if` is asked of each command for which the planner says nothing else. What is asked of is sent after
    the answer that nothing speaks against it, and not without.
    """

    def __init__(
        self,
        model: DigitalModel,
        clock: Clock,
        *,
        bounds: Bounds,
        what_if: WhatIf | None = None,
        question: Question | None = None,
    ) -> None:
        super().__init__("execute", clock)
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
        """Whether a command waits for an answer; what is planned meanwhile waits behind it."""
        return self._pending is not None

    def change_state(self, command: COMMAND) -> str:
        """ChangeState: the model takes the command, or says why not and stays as it is."""
        objection = self._check.objection(command)
        if not objection:
            self.digital_model.process_event(command)
            self._check.take()
        return objection

    def execute(self) -> None:
        """Deal with what is planned, in order, up to the first command of which an answer is still to come."""
        while self._pending is not None or self.plans.queue:
            command, objection = self._next()
            if objection is None:
                return
            self._settle(command, objection or self.change_state(command))

    def give_up(self, why: str) -> None:
        """The twin ends: what waits for an answer is not sent, nor what waits behind it."""
        waiting = [*self.plans.drain()] if self._pending is None else [self._pending, *self.plans.drain()]
        self._pending = None
        for command in waiting:
            self._settle(command, why)

    def _next(self) -> tuple[COMMAND, str | None]:
        """The first command, and what speaks against it before the model takes it; None: that is still being asked."""
        if self._pending is None:
            command = self.plans.consume()
            question = command.question if isinstance(command, PlannedCommand) else self._question
            objection = self._check.objection(command)
            if objection or question is None:
                return command, objection
            if self._what_if is None:
                return command, "a prototype was to be asked first, and nobody here can"
            self._pending = command
            self.asked += 1
            self._what_if.ask(command, question)
        assert self._what_if is not None
        command, answer = self._pending, self._what_if.answer()
        if answer is not None:
            self._pending = None
        return command, answer

    def _settle(self, command: COMMAND, objection: str) -> None:
        if objection:
            self.refused += 1
            self.share(Kind.REFUSAL, self.name, _told(command, objection))
        else:
            self.sent += 1
            self.transmitter.emit(command)


def _told(command: COMMAND, objection: str) -> str:
    """The reason, and of which command where it does not say that by itself."""
    try:
        period_s = decode_period(command)
    except Desync:
        return objection
    return objection if objection.startswith("a period of") else f"period {period_s} s: {objection}"
