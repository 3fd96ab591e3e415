"""The plant's own say over commands from its digital twin: its switch, its limits, its rate, from its own file.

A plant does not rely on the twin that commands it. Every command is answered for: taken, or refused with the reason, and that is
knowledge. What was taken once is never taken again: a thread tells each number once (`fieldtwin.twin.thread.end`), and numbers
only grow.

Pure but for the clock that it is given.
"""

from __future__ import annotations

from fieldtwin.gateway.core.clock import Clock
from fieldtwin.gateway.core.values import COMMAND
from fieldtwin.gateway.store.event import Event, Kind
from fieldtwin.twin.model.mape.execute import Bounds, CommandCheck
from fieldtwin.twin.model.thread_process import PTDigitalThreadProcess

OLD_MS = 10 * 60_000
"""A command that was under way for longer is not obeyed: what it was meant for is over. Neither is one from so far ahead: its age
would never count.
"""


class CommandGate(PTDigitalThreadProcess):
    """`admit` looks at an event of the twin's log; the command, or None where it was refused. It shares what became of each."""

    def __init__(self, *, remote: bool, bounds: Bounds, clock: Clock, old_ms: int = OLD_MS, since_ms: int = 0) -> None:
        """`since_ms`: when the plant's own log began (UTC); what was commanded before may have been obeyed, and nobody knows."""
        super().__init__("command gate", clock)
        self.taken = self.refused = 0
        self._remote = remote
        self._check = CommandCheck(bounds, clock)
        self._old_ms = old_ms
        self._since_ms = since_ms
        self._last: dict[str, int] = {}

    def restate(self, *, remote: bool, bounds: Bounds) -> None:
        """The switch and the limits as they are now: a plant that runs may have them changed."""
        self._remote = remote
        self._check.restate(bounds)

    def admit(self, origin: str, event: Event) -> COMMAND | None:
        """Take a command of the twin's log, or refuse it. What is no command is none of the gate's business."""
        if event.kind != Kind.COMMAND:
            return None
        if event.sequence <= self._last.get(origin, 0):
            self._refuse(f"number {event.sequence} of {origin} was taken already")
            return None
        self._last[origin] = event.sequence
        command = COMMAND(event.value if isinstance(event.value, bytes) else b"", event.name)
        objection = self._objection(command, event)
        if objection:
            self._refuse(f"number {event.sequence} of {origin}: {objection}")
            return None
        self._check.take()
        self.taken += 1
        self.share(Kind.COMMAND, origin, command)
        return command

    def _objection(self, command: COMMAND, event: Event) -> str:
        if not self._remote:
            return "the plant says local"
        age_ms = self._clock.utc_ns() // 1_000_000 - event.t_ms
        if age_ms > self._old_ms:
            return f"it is {age_ms // 1000} s old; at most {self._old_ms // 1000} s are obeyed"
        if age_ms < -self._old_ms:
            return f"its time is {-age_ms // 1000} s ahead of this clock; at most {self._old_ms // 1000} s are accepted"
        if event.t_ms < self._since_ms:
            return "it is from before this plant's log began, and may have been obeyed then"
        return self._check.objection(command)

    def _refuse(self, why: str) -> None:
        self.refused += 1
        self.share(Kind.REFUSAL, self.name, why)
