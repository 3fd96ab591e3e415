"""The last known state of a system, updated with events as they arrive. A fork starts from it.

This module must never know where the events come from, nor how a fork is started.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from fieldtwin.gateway.core.errors import Desync
from fieldtwin.gateway.core.statemachine import STATES, encode_period
from fieldtwin.gateway.core.values import Quality
from fieldtwin.gateway.store.event import Event, Kind
from fieldtwin.run.what_if.state import KnownState, Number
from fieldtwin.twin.model.model import DigitalModel
from fieldtwin.twin.model.status import decode_status
from fieldtwin.twin.site.system import System


class LastKnown:
    """The newest value of each name. The caller passes events to `take`, which accepts those of one or several logs, each in
    order.

    A value that turned bad is not known.
    """

    def __init__(self, system: System) -> None:
        self.utc_ms = 0
        self._tags = {f"{d.name}.{t.name}" for d in system.devices.values() for t in d.profile.tags.values()}
        self._programs = frozenset(system.plc.programs)
        self._values: dict[str, Number] = {}
        self._states: dict[str, Mapping[str, Number]] = {}
        self._when_ms: dict[str, int] = {}

    def take(self, events: Iterable[Event]) -> None:
        for event in events:
            if event.kind == Kind.VALUE and event.name in self._tags and self._is_news(event):
                if event.quality >= Quality.BAD or event.value is None or isinstance(event.value, bytes):
                    self._values.pop(event.name, None)
                else:
                    self._values[event.name] = event.value
            elif event.kind == Kind.STATE and event.name in self._programs and self._is_news(event):
                state = of_status(event.value if isinstance(event.value, bytes) else b"")
                if state:
                    self._states[event.name] = state

    def _is_news(self, event: Event) -> bool:
        if event.t_ms < self._when_ms.get(event.name, 0):
            return False
        self._when_ms[event.name] = event.t_ms
        self.utc_ms = max(self.utc_ms, event.t_ms)
        return True

    @property
    def unknown(self) -> str:
        """Return a description of the values that a fork needs and that are still unknown: the state of a program, or every
        tag. Empty if none.
        """
        silent = sorted(self._programs - self._when_ms.keys())
        if silent:
            return f"the state of {', '.join(silent)}"
        return "" if self._when_ms.keys() & self._tags else "any value"

    def state(self, source: str) -> KnownState:
        """Return the state that is known now."""
        return KnownState(dict(self._values), dict(self._states), self.utc_ms, source)


def of_period(period_s: int) -> dict[str, Number]:
    """Return the variables of a program with the reference state machine, after a command of `period_s`."""
    model = DigitalModel()
    state = model.process_event(encode_period(period_s))
    return {"period": period_s, "period_s": period_s, "state": list(STATES).index(state.name)}


def of_status(data: bytes) -> dict[str, Number]:
    """Return the same variables from a STATUS message, which has state and period; empty if `data` is another message."""
    try:
        name, period_s = decode_status(data)
    except Desync:
        return {}
    return {**of_period(period_s), "state": list(STATES).index(name)}
