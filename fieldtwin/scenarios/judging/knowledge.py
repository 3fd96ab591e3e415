"""The known values of the system under test: for expressions, and in words for reports.

A tag's quality is unknown until the tag has had a value: a tag that was never published has not turned bad. The texts
for reports are taken from the bench and from the trace, so that both agree.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable
from typing import Any

from fieldtwin.capture.decoding.exchange import SECRET
from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.conditions.decimals import as_decimal
from fieldtwin.gateway.core.conditions.expression import Expression
from fieldtwin.results.trace import TraceEvent, TraceKind
from fieldtwin.scenarios.bench import Bench
from fieldtwin.scenarios.judging.expectation import is_secret
from fieldtwin.twin.site.system import System

PENDING_S = 5.0
"""How long ``command pending`` is true after the remote client's command, in seconds."""


class Knowledge:
    """The known values of one running system.

    `known` are the names that expressions may contain. The caller passes each event of the trace to `hear`.
    """

    def __init__(self, system: System, known: Collection[str], bench: Bench) -> None:
        self._system = system
        self._known = known
        self._bench = bench
        self._sent_s = float("-inf")  # no command was sent yet
        self._last: dict[str, TraceEvent] = {}
        """The latest event about each tag or variable."""
        self._valued: set[str] = set()
        """Tags and variables that have had a value."""

    def hear(self, event: TraceEvent) -> None:
        """Process an event of the trace."""
        if event.kind in (TraceKind.TAG, TraceKind.STATE, TraceKind.ALARM):
            self._last[event.where] = event
            if event.data.get("value") is not None:
                self._valued.add(event.where)

    def commanded(self) -> None:
        """Record that the remote client sends a command now."""
        self._sent_s = self._bench.now_s()

    def look(self, function: str, name: str) -> Any:
        """Return the current value of `function` for `name`, or None if it is unknown: a
        `fieldtwin.gateway.core.conditions.expression.Look`.
        """
        if name == "plc.late":
            return self._bench.late_ms() / 1000
        if name == "command_pending":
            return self._bench.now_s() - self._sent_s <= PENDING_S
        reading = self._bench.reading(name)
        if reading is None:
            return 0 if function == "updates" else None
        if function == "quality":
            return reading.quality if reading.value is not None else None
        return reading.age_s if function == "age" else getattr(reading, function)

    def all_read(self, expression: Expression) -> bool:
        """Return whether every name of the expression has been read."""
        return all(self._bench.reading(name) is not None for name in expression.names)

    def of_expression(self, expression: Expression) -> str:
        """Return the current values of all names in the expression as text."""
        late = [f"scans up to {self._bench.late_ms():.3g} ms late"] if expression.asks_lateness else []
        return "; ".join([*late, *([self.of(expression.names)] if expression.names else [])])

    def of(self, names: Iterable[str]) -> str:
        """Return the current values of tags and variables as text. Other names are left out."""
        known = [name for name in dict.fromkeys(names) if name in self._known]
        return "; ".join(f"{name}: {self._in_words(name)}" for name in known)

    def _in_words(self, name: str) -> str:
        reading, secret = self._bench.reading(name), is_secret(self._system, name)
        if reading is not None:
            value = "no value," if reading.value is None else SECRET if secret else repr(as_decimal(reading.value))
            why = f" ({reading.reason.replace('_', ' ')})" if reading.quality == "bad" and reading.reason else ""
            age = f", {reading.age_s:.3f} s old" if reading.value is not None else ""
            return f"{value} {reading.quality}{why}{age}"
        last, why = self._last.get(name), self._bench.why_unknown(name)
        if last is None:
            return f"never published{f' ({why})' if why else ''}"
        at = f"{last.t_ns / NS_PER_S:.3f} s"
        if last.kind is TraceKind.STATE and last.data.get("value") is not None:
            return f"never read back; a program set it to {SECRET if secret else repr(as_decimal(last.data['value']))} at {at}"
        why = why or str(last.data.get("reason", "")).replace("_", " ")
        return f"no value{f' since {at}' if name in self._valued else ' yet'}{f' ({why})' if why else ''}"
