"""The alarm list of a gateway: it evaluates the conditions of alarms, and carries out acknowledgement and shelving.

A value with bad quality is unknown in a condition. If the result depends on it, the alarm keeps its state and its quality is bad,
so that neither an active nor a normal alarm is published as good. Alarms begin as normal, with bad quality; nothing is kept over
a restart of the gateway.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from fieldtwin.gateway.core.clock import NS_PER_MS, NS_PER_S
from fieldtwin.gateway.core.conditions.expression import Expression
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.gateway.core.files.nearest import did_you_mean
from fieldtwin.gateway.core.values import NEVER, Quality, Reason, Scalar, TagValue
from fieldtwin.gateway.runtime.alarms.state_machine import (
    ACKNOWLEDGEABLE,
    NEVER_DUE_NS,
    AlarmState,
    AlarmStateMachine,
)
from fieldtwin.gateway.runtime.audit_log import AuditLog
from fieldtwin.gateway.runtime.gateway_status import AlarmEvent, AlarmStatus
from fieldtwin.gateway.runtime.tags import TagTable

ALARM = "alarm"
"""The first part of the names of alarms among those of tags and variables: ``alarm.NAME``."""
EVENTS_KEPT = 10_000
"""The largest number of changes of alarms that are kept for clients. The oldest ones are dropped first."""
LONGEST_SHELVING_S = 86_400.0
_BAD = Quality.BAD
_NO_WORDS: Mapping[int, str] = {}


@dataclass(frozen=True)
class AlarmConfig:
    """The configuration of one alarm. `words` are the texts of the numbers of programs' states in `condition`, by name."""

    name: str
    condition: Expression
    priority: str
    text: str = ""
    on_delay_ms: int = 0
    off_delay_ms: int = 0
    acknowledge: bool = True
    words: Mapping[str, Mapping[int, str]] = field(default_factory=dict)


class AlarmList:
    """The alarms of a gateway, in the order of the system file. The gateway calls `tick` in each of its cycles.

    `on_event` is called with each change of state or quality; it must not raise.
    """

    def __init__(self, configs: Sequence[AlarmConfig], tags: TagTable, audit: AuditLog) -> None:
        self._audit = audit
        self._alarms = {config.name: _Alarm(config) for config in configs}
        self._tags = tags
        self._outputs: Mapping[str, TagValue] = {}
        self._plc_alive = False
        self._dirty = True
        """Whether a value may have changed since the conditions were last evaluated."""
        self._again_ns = 0
        """The time from which the conditions must be evaluated again although no value was stored."""
        self._events: deque[AlarmEvent] = deque(maxlen=EVENTS_KEPT)
        self.last_event = 0
        """The number of the newest event; numbers begin with 1."""
        self.on_event: Callable[[AlarmEvent], None] | None = None
        self._stored = dict.fromkeys((name for config in configs for name in config.condition.names), _content(NEVER))
        """Value, quality and reason that were stored last of each tag in a condition."""
        if configs:
            tags.subscribe(self._put)

    def _put(self, name: str, value: TagValue) -> None:
        if name in self._stored and self._stored[name] != (now := _content(value)):
            self._stored[name] = now
            self._dirty = True

    def look_again(self) -> None:
        """Evaluate the conditions in the next cycle, because the age limits of tags have changed."""
        self._dirty = True

    def __bool__(self) -> bool:
        return bool(self._alarms)

    def tick(self, now_ns: int, outputs: Mapping[str, TagValue], *, plc_alive: bool) -> None:
        """Evaluate the conditions. `outputs` are the PLC's outputs and variables, which are bad unless `plc_alive`."""
        if outputs is not self._outputs or plc_alive != self._plc_alive:
            self._outputs, self._plc_alive, self._dirty = outputs, plc_alive, True
        if not self._alarms or not (self._dirty or now_ns >= self._again_ns):
            return
        self._dirty = False
        for alarm in self._alarms.values():
            values = _Values(self, now_ns, alarm.config.words)
            alarm.step(alarm.config.condition.truth(values.look), values, now_ns)
            self._note(alarm, now_ns)
        self._again_ns = min(self._stale_ns(now_ns), *(alarm.machine.due_ns for alarm in self._alarms.values()))

    def repeats_until(self, until_ns: int) -> bool:
        """Return whether each `tick` before `until_ns` changes nothing if no value is stored before that."""
        return not self._alarms or (not self._dirty and until_ns <= self._again_ns)

    def _stale_ns(self, now_ns: int) -> int:
        """Return the time at which a value in a condition becomes stale.

        A stale value can become good again without a notice, if the same sample is read again. It is then checked in each cycle.
        """
        earliest_ns = NEVER_DUE_NS
        for name in self._stored:
            if name in self._tags and self._tags.held(name).quality is not _BAD:
                earliest_ns = min(earliest_ns, self._tags.fresh_until_ns(name) + 1)
        return earliest_ns

    def value(self, name: str, now_ns: int) -> TagValue:
        """Return the present value of a tag or variable."""
        if name in self._tags:
            return self._tags.current(name, now_ns)
        seen = self._outputs.get(name, NEVER)
        return seen if self._plc_alive else TagValue(seen.value, _BAD, Reason.NOT_OPERATIONAL, seen.t_ns)

    # -- actions of operators ------------------------------------------------------------------------------------------

    def acknowledge(self, name: str, by: str, now_ns: int, comment: str = "") -> None:
        """Acknowledge an alarm for the user `by`, whose `comment` goes to the audit log. Raises `UsageError` if there is nothing
        to acknowledge.

        This and the next two actions are recorded in the audit log first. They raise `Unreachable` if that fails.
        """
        alarm = self._of(name)
        if alarm.machine.state not in ACKNOWLEDGEABLE:
            raise UsageError(
                f"alarm {name!r} has nothing to acknowledge",
                expected=" or ".join(state.value for state in ACKNOWLEDGEABLE),
                got=alarm.machine.state.value,
            )
        details = {"comment": comment} if comment else {}
        self._audit.note("acknowledge", f"{ALARM}.{name}", by=by, result="done", **details)
        alarm.machine.acknowledge()
        self._note(alarm, now_ns, by)

    def shelve(self, name: str, for_s: float, by: str, now_ns: int) -> None:
        """Shelve an alarm for `for_s` seconds from now. Raises `UsageError` for a time that is not allowed."""
        alarm = self._of(name)
        if not 0 < for_s <= LONGEST_SHELVING_S:
            raise UsageError(
                f"the time for which alarm {name!r} is shelved",
                expected=f"more than 0 and at most {LONGEST_SHELVING_S:g} s",
                got=f"{for_s:g}",
            )
        self._audit.note("shelve", f"{ALARM}.{name}", by=by, result="done", for_s=for_s)
        alarm.machine.shelve(now_ns + int(for_s * NS_PER_S))
        self._again_ns = min(self._again_ns, alarm.machine.due_ns)
        self._note(alarm, now_ns, by)

    def unshelve(self, name: str, by: str, now_ns: int) -> None:
        """End the shelving of an alarm. Raises `UsageError` if it is not shelved."""
        alarm = self._of(name)
        if alarm.machine.state is not AlarmState.SHELVED:
            raise UsageError(f"alarm {name!r} is not shelved", expected="shelved", got=alarm.machine.state.value)
        self._audit.note("unshelve", f"{ALARM}.{name}", by=by, result="done")
        alarm.machine.unshelve()
        self._note(alarm, now_ns, by)

    def _of(self, name: str) -> _Alarm:
        if name not in self._alarms:
            expected = ", ".join(self._alarms) or "none; the system file has no `alarms`"
            raise UsageError(f"no alarm {name!r}", expected=expected, hint=did_you_mean(name, self._alarms))
        return self._alarms[name]

    # -- readers -------------------------------------------------------------------------------------------------------

    @property
    def names(self) -> list[str]:
        """Return the names of all alarms, in the order of the system file."""
        return list(self._alarms)

    def present(self, name: str) -> AlarmEvent:
        """Return the last change of an alarm; number 0 if it has not changed. Raises `UsageError` for an unknown alarm."""
        return self._of(name).event

    def statuses(self, now_ns: int) -> dict[str, AlarmStatus]:
        """Return the status of each alarm, by name."""
        return {name: alarm.status(now_ns) for name, alarm in self._alarms.items()}

    def events_since(self, number: int) -> list[AlarmEvent]:
        """Return the changes after `number` that are still kept, the oldest first."""
        return [event for event in self._events if event.number > number]

    def _note(self, alarm: _Alarm, now_ns: int, by: str = "") -> None:
        if not alarm.change(self.last_event + 1, now_ns, by):
            return
        self.last_event += 1
        self._events.append(alarm.event)
        if self.on_event is not None:
            self.on_event(alarm.event)


class _Alarm:
    """One alarm: its configuration, its state machine, and its last change."""

    def __init__(self, config: AlarmConfig) -> None:
        self.config = config
        self.machine = AlarmStateMachine(
            config.on_delay_ms * NS_PER_MS, config.off_delay_ms * NS_PER_MS, config.acknowledge
        )
        self._quality, self._reason = _BAD, Reason.NEVER_READ
        self.event = AlarmEvent(
            number=0,
            t_ns=0,
            name=config.name,
            state=AlarmState.NORMAL.value,
            active=False,
            quality=str(self._quality),
            reason=_text(self._reason),
            by="",
        )
        self._since_ns = 0

    def step(self, condition: bool | None, values: _Values, now_ns: int) -> None:
        self.machine.step(condition, now_ns)
        if condition is None:
            self._quality, self._reason = _BAD, values.why_unknown
        else:
            self._quality, self._reason = values.worst, Reason.NONE

    def change(self, number: int, now_ns: int, by: str) -> bool:
        """Return whether state, condition or quality differ from the last event, which is then replaced."""
        last = self.event
        event = AlarmEvent(
            number=number,
            t_ns=now_ns,
            name=self.config.name,
            state=self.machine.state.value,
            active=self.machine.is_active,
            quality=str(self._quality),
            reason=_text(self._reason),
            by=by,
        )
        now = (event.state, event.active, event.quality, event.reason)
        if now == (last.state, last.active, last.quality, last.reason):
            return False
        if event.state != last.state:
            self._since_ns = now_ns
        self.event = event
        return True

    def status(self, now_ns: int) -> AlarmStatus:
        config, until_ns = self.config, self.machine.shelved_until_ns
        return AlarmStatus(
            state=self.event.state,
            active=self.event.active,
            quality=self.event.quality,
            reason=self.event.reason,
            priority=config.priority,
            text=config.text,
            condition=config.condition.text,
            acknowledge=config.acknowledge,
            by=self.event.by,
            in_state_s=(now_ns - self._since_ns) / NS_PER_S if self._since_ns else None,
            shelved_for_s=(until_ns - now_ns) / NS_PER_S if until_ns else None,
        )


class _Values:
    """The values of one evaluation of a condition, with the worst quality of those that the result depends on."""

    def __init__(self, alarms: AlarmList, now_ns: int, words: Mapping[str, Mapping[int, str]]) -> None:
        self._alarms = alarms
        self._now_ns = now_ns
        self._words = words
        self.worst = Quality.GOOD
        self.why_unknown = Reason.NOT_A_NUMBER

    def look(self, function: str, name: str) -> Any:
        """Return the quality, reason or value of a tag or variable; None for a bad value."""
        seen = self._alarms.value(name, self._now_ns)
        if function == "quality":
            return str(seen.quality)
        if function == "reason":
            return _text(seen.reason)
        if seen.quality is _BAD:
            self.why_unknown = seen.reason
            return None
        self.worst = max(self.worst, seen.quality)
        value = seen.value.hex() if isinstance(seen.value, bytes) else seen.value
        return self._words.get(name, _NO_WORDS).get(value, value) if isinstance(value, int) else value


def _content(value: TagValue) -> tuple[Scalar | None, Quality, Reason]:
    return value.value, value.quality, value.reason


def _text(reason: Reason) -> str:
    return str(reason).replace(" ", "_")
