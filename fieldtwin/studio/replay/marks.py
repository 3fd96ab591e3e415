"""The marks of a run: faults, transitions of programs, steps of the scenario, and failed checks."""

from __future__ import annotations

import itertools
from typing import Any

from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.results.trace_about import CheckAbout, TraceAbout
from fieldtwin.studio.live.tag_history import Point
from fieldtwin.studio.replay.trace_log import BAD_VERDICTS, FaultEvent, TraceLog

MOST_MARKS = 2_000
"""Largest number of marks in one answer. Failed checks come first, then faults, then transitions."""
MOST_TRANSITIONS = 200
"""Largest number of transitions of a program that are returned, the latest ones before an instant."""


def marks_of(log: TraceLog, about: TraceAbout | None, programs: list[str]) -> tuple[list[dict[str, Any]], int]:
    """Return the marks in the order of their times, and how many were left out."""
    found = [
        {"t_ns": check.t_ns, "kind": "failed", "text": check.text, "number": check.number}
        for check in failed_checks(log, about)
        if check.t_ns is not None
    ]
    for begins_ns, ends_ns, fault in _active(log.faults):
        text = f"{fault['name']} on {fault['device'] or fault['bus']}"
        found.append({"t_ns": begins_ns, "kind": "fault", "text": text})
        if ends_ns is not None:
            found.append({"t_ns": ends_ns, "kind": "cleared", "text": f"{text} ends"})
    room = max(0, MOST_MARKS - len(found))
    left_out = max(0, len(found) - MOST_MARKS)
    del found[MOST_MARKS:]
    for program in programs:
        changes = state_changes(log, program, log.last_ns, most=room)
        left_out += max(0, len(log.states.get(_state(program), ())) - 1 - len(changes))
        for before, after in changes:
            found.append({"t_ns": after.t_ns, "kind": "state", "text": f"{program}: {before.value} to {after.value}"})
        room -= len(changes)
    return sorted(found, key=lambda mark: mark["t_ns"]), left_out


def failed_checks(log: TraceLog, about: TraceAbout | None) -> list[CheckAbout]:
    """Return the failed checks: those in the description of the trace or, while the run continues, the failed steps."""
    if about is not None and about.finished:
        return [check for check in about.checks if check.verdict in BAD_VERDICTS]
    return [
        CheckAbout(number=step.number, text=step.text, verdict=step.verdict, t_ns=step.t_ns)
        for step in log.steps
        if step.verdict in BAD_VERDICTS
    ]


def faults_at(log: TraceLog, t_ns: int) -> list[dict[str, Any]]:
    """Return the faults that are active at an instant."""
    return [
        fault
        for begins_ns, ends_ns, fault in _active(log.faults)
        if begins_ns <= t_ns and (ends_ns is None or t_ns < ends_ns)
    ]


def step_at(log: TraceLog, t_ns: int) -> dict[str, Any] | None:
    """Return the latest event of a step at an instant."""
    step = next((step for step in reversed(log.steps) if step.t_ns <= t_ns), None)
    return None if step is None else step._asdict()


def state_changes(log: TraceLog, program: str, t_ns: int, most: int = MOST_TRANSITIONS) -> list[tuple[Point, Point]]:
    """Return the last changes of a program's state up to an instant, the oldest first, each as (before, after)."""
    series = log.states.get(_state(program))
    if series is None or most <= 0:
        return []
    last = series.last_at(t_ns)
    points = [log.point(series, position) for position in range(max(0, last - most), last + 1)]
    return list(itertools.pairwise(points))


def _state(program: str) -> str:
    return f"{program}.state"


def _active(events: list[FaultEvent]) -> list[tuple[int, int | None, dict[str, Any]]]:
    """Return each fault as (begin in ns, end in ns or None, data). The fault's own `from` and `until` can limit its time."""
    found: list[tuple[int, int | None, dict[str, Any]]] = []
    open_: dict[str, int] = {}
    for event in events:
        known = open_.pop(event.id, None)
        if known is not None:
            begins_ns, ends_ns, fault = found[known]
            found[known] = begins_ns, event.t_ns if ends_ns is None else min(ends_ns, event.t_ns), fault
        if not event.on:
            continue
        said = event.data.get("said")
        said = said if isinstance(said, dict) else {}
        begins_ns, ends_ns = _ns(said.get("from")) or 0, _ns(said.get("until"))
        fault = {
            "id": event.id,
            "name": str(event.data.get("name", "")),
            "device": str(said.get("device") or ("" if said else event.data.get("target", ""))),
            "bus": str(said.get("bus") or ""),
            "struck": 0,
        }
        open_[event.id] = len(found)
        found.append((max(event.t_ns, begins_ns), ends_ns, fault))
    return [one for one in found if one[1] is None or one[1] > one[0]]


def _ns(value: Any) -> int | None:
    """Return a time of a fault file, such as ``10s``, in ns; None if the time is missing or invalid."""
    from fieldtwin.emulators.faults.schema import seconds  # here: a plant has no emulators installed

    if not isinstance(value, int | float | str):
        return None
    try:
        return round(seconds(value) * NS_PER_S)
    except (UsageError, ValueError, OverflowError):
        return None
