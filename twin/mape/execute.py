"""Execute: the last stage. A command is held against the digital model first; only what the model accepts is sent.

No user steps in. A refusal is an event with its reason (SPEC ruling 9), and is kept.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from gateway.core.clock import NS_PER_S, Clock
from gateway.core.errors import Desync
from gateway.core.events import Consumer, Producer
from gateway.core.statemachine import PERIOD_MAX, PERIOD_MIN, decode_period
from gateway.core.values import COMMAND
from gateway.store.event import Kind
from twin.model import DigitalModel
from twin.thread_process import DTDigitalThreadProcess

CAPACITY = 1000
MINUTE_NS = 60 * NS_PER_S

WhatIf = Callable[[COMMAND], str]
"""Asks a prototype what a command would lead to; why it is not to be sent, or empty."""


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
    """SPEC row Execute: consume ; ChangeState ; emit. `transmitter` emits what is to be sent, in order."""

    def __init__(self, model: DigitalModel, clock: Clock, *, bounds: Bounds, what_if: WhatIf | None = None) -> None:
        super().__init__("execute", clock)
        self.plans: Consumer[COMMAND] = Consumer("planned", CAPACITY)
        self.transmitter: Producer[COMMAND] = Producer("to the plant")
        self.digital_model = model
        self.sent = self.refused = 0
        self._check = CommandCheck(bounds, clock)
        self._what_if = what_if

    def change_state(self, command: COMMAND) -> str:
        """ChangeState: the model takes the command, or says why not and stays as it is."""
        objection = self._check.objection(command)
        if not objection and self._what_if is not None:
            objection = self._what_if(command)
        if not objection:
            self.digital_model.process_event(command)
            self._check.take()
        return objection

    def execute(self) -> None:
        for command in self.plans.drain():
            objection = self.change_state(command)
            if objection:
                self.refused += 1
                self.share(Kind.REFUSAL, self.name, objection)
            else:
                self.sent += 1
                self.transmitter.emit(command)
