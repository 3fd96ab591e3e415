"""The alarms of a run at an instant of its trace, in the form of the gateway's status."""

from __future__ import annotations

from bisect import bisect_right
from typing import Any, NamedTuple

from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.runtime.alarms.alarm_list import ALARM
from fieldtwin.gateway.runtime.alarms.state_machine import AlarmState
from fieldtwin.twin.site.alarm_forms import AlarmForm


class AlarmChange(NamedTuple):
    """A change of an alarm, with the values after it."""

    t_ns: int
    state: str
    active: bool
    quality: str
    reason: str
    by: str


UNKNOWN = AlarmChange(0, AlarmState.NORMAL.value, False, "bad", "never_read", "")
"""An alarm before its first change."""


def change_of(t_ns: int, data: dict[str, Any]) -> AlarmChange:
    """Return the change that an event of a trace describes. Raises `KeyError` for data without state or quality."""
    return AlarmChange(
        t_ns,
        str(data["value"]),
        data.get("active") is True,
        str(data["quality"]),
        str(data.get("reason", "")),
        str(data.get("by", "")),
    )


def alarms_at(
    changes: dict[str, list[AlarmChange]], forms: dict[str, AlarmForm], t_ns: int
) -> dict[str, dict[str, Any]]:
    """Return each alarm as of an instant. `changes` are those of each name, such as ``alarm.level_high``, in order of time."""
    return {name: _alarm(changes.get(f"{ALARM}.{name}", []), form, t_ns) for name, form in forms.items()}


def _alarm(changes: list[AlarmChange], form: AlarmForm, t_ns: int) -> dict[str, Any]:
    at = bisect_right(changes, t_ns, key=lambda change: change.t_ns)
    now = changes[at - 1] if at else UNKNOWN
    first = at - 1
    while first > 0 and changes[first - 1].state == now.state:
        first -= 1
    has_changed = first > 0 or now.state != UNKNOWN.state
    return {
        "state": now.state,
        "active": now.active,
        "quality": now.quality,
        "reason": now.reason,
        "priority": form.priority,
        "text": form.text,
        "condition": form.condition,
        "acknowledge": form.acknowledge,
        "by": now.by,
        "in_state_s": (t_ns - changes[first].t_ns) / NS_PER_S if has_changed else None,
        "shelved_for_s": None,
    }
