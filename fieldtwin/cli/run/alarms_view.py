"""The alarm list as text, for the live table of a run and for `fieldtwin alarm`."""

from __future__ import annotations

from collections.abc import Mapping

from rich.table import Table
from rich.text import Text

from fieldtwin.gateway.runtime.alarms.state_machine import AlarmState
from fieldtwin.gateway.runtime.gateway_status import AlarmStatus

_COLOUR = {
    AlarmState.UNACKNOWLEDGED.value: "bold red",
    AlarmState.ACKNOWLEDGED.value: "red",
    AlarmState.RETURNED.value: "yellow",
    AlarmState.SHELVED.value: "cyan",
}
PRIORITIES = ("critical", "high", "medium", "low")
"""The priorities, the most important one first."""
MOST_ALARMS = 10
"""The largest number of alarms in the live table."""


def standing(alarms: Mapping[str, AlarmStatus]) -> dict[str, AlarmStatus]:
    """Return the alarms that are not normal or not known, by priority; within a priority in the order of the system file."""
    found = {n: a for n, a in alarms.items() if a.state != AlarmState.NORMAL.value or a.quality == "bad"}
    return dict(sorted(found.items(), key=lambda item: PRIORITIES.index(item[1].priority)))


def alarm_table(alarms: Mapping[str, AlarmStatus]) -> Table:
    """Return a table of alarms with state, quality, priority, the time in the state, and the operator's text."""
    table = Table(expand=False, pad_edge=False, box=None, header_style="dim")
    for column in ("alarm", "state", "quality", "priority"):
        table.add_column(column, no_wrap=True)
    table.add_column("for", justify="right", no_wrap=True)
    table.add_column("text")
    for name, alarm in alarms.items():
        quality = alarm.quality + (f" ({alarm.reason.replace('_', ' ')})" if alarm.quality == "bad" else "")
        table.add_row(
            name,
            Text(alarm.state.replace("_", " "), _COLOUR.get(alarm.state, "")),
            Text(quality, "red" if alarm.quality == "bad" else ""),
            alarm.priority,
            _time(alarm.in_state_s),
            Text(alarm.text + (f" (by {alarm.by})" if alarm.by else "")),
        )
    return table


def alarms_line(alarms: Mapping[str, AlarmStatus]) -> str:
    """Return the names of the alarms that are active or wait for an acknowledgement, separated by commas."""
    calm = (AlarmState.NORMAL.value, AlarmState.SHELVED.value)
    return ",".join(name for name, alarm in standing(alarms).items() if alarm.state not in calm)


def _time(s: float | None) -> str:
    if s is None:
        return "-"
    return f"{s:.0f} s" if s < 100 else f"{s / 60:.0f} min" if s < 6000 else f"{s / 3600:.0f} h"
