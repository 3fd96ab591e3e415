"""The plant's own control over commands from its digital twin: a switch (remote or local), limits and a rate, which the system
file of the plant states.

A plant does not rely on the twin that commands it. For every command the gate records as knowledge that it was taken,
or why it was refused. A command is never taken twice: a thread passes on each number once
(`fieldtwin.twin.thread.end`), and numbers only grow.

This module performs no I/O; it reads the time from the clock that it is given.
"""

from __future__ import annotations

from fieldtwin.gateway.core.clock import Clock
from fieldtwin.gateway.core.values import COMMAND
from fieldtwin.gateway.store.event import Event, Kind
from fieldtwin.twin.model.mape.execute import CommandCheck, CommandLimits
from fieldtwin.twin.model.thread_process import PTDigitalThreadProcess

OLD_MS = 10 * 60_000
"""A command that is older than this is refused, because its purpose has passed. So is one that is this far ahead of the
local clock, because its age would never count.
"""


class CommandGate(PTDigitalThreadProcess):
    """The gate for commands: `admit` takes an event of the twin's log and returns the command, or None if it was refused.

    The outcome of each command is shared with the twin.
    """

    def __init__(
        self, *, remote: bool, bounds: CommandLimits, clock: Clock, old_ms: int = OLD_MS, since_ms: int = 0
    ) -> None:
        """Create the gate. `since_ms` is the time when the plant's own log began (UTC).

        An earlier command is refused, because the plant may already have obeyed it.
        """
        super().__init__("command gate", clock)
        self.taken = self.refused = 0
        self._remote = remote
        self._check = CommandCheck(bounds, clock)
        self._old_ms = old_ms
        self._since_ms = since_ms
        self._last: dict[str, int] = {}

    def restate(self, *, remote: bool, bounds: CommandLimits) -> None:
        """Set a new switch position and new limits. Both may change while the plant runs."""
        self._remote = remote
        self._check.restate(bounds)

    def admit(self, origin: str, event: Event) -> COMMAND | None:
        """Return the command of an event of the twin's log; None if it is refused, or if the event is not a command."""
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
            return "the plant is switched to local"
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
