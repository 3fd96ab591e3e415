"""Turn a recorded run into a scenario: its inputs become stimuli, its outputs expectations with tolerance and window.

Stimuli are the commands of the remote client, faults and, on request, device values; the emulators of the scenario's prototype
replay their recordings without stimuli. This module performs no I/O: it converts a `RunHistory` to text.
"""

from __future__ import annotations

import json
from bisect import bisect_right
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.conditions.decimals import as_decimal
from fieldtwin.gateway.core.errors import FieldtwinError, UsageError
from fieldtwin.gateway.core.statemachine import decode_period
from fieldtwin.gateway.core.values import COMMAND
from fieldtwin.scenarios.regression.run_history import RunHistory, ValueChange
from fieldtwin.twin.site.system import System

BRIEF_NS = 200_000_000
"""The scenario does not expect states that last shorter than this (ns), because a check could come too late."""
RESTLESS = 3
"""A tag that changes more often than this between two stimuli is compared with its device's register, not with a constant."""
MOST_STEPS = 5_000
AHEAD_NS = 200_000_000
"""Time before the next stimulus at which tags are compared, in ns."""
STOPPING_NS = 2 * NS_PER_S
"""The last part of a run, in ns, whose changes are not expected: the outputs become safe and the devices disconnect."""


@dataclass(frozen=True)
class ScenarioOptions:
    """The options of the scenario.

    `share` is the tolerance of a value, as a fraction of it; `window_s` is the allowed delay. With `values`, the scenario also
    sets device values, for a prototype that replays different recordings.
    """

    name: str
    system: str
    """The system, as the scenario file is to name it."""
    share: float = 0.01
    window_s: float = 1.0
    seed: int | None = None
    values: bool = False
    source: str = ""


@dataclass(frozen=True)
class _Stimulus:
    t_ns: int
    step: str


def as_scenario(system: System, history: RunHistory, wanted: ScenarioOptions) -> str:
    """Return the text of the scenario file.

    Raises `UsageError` for a run without anything to expect, or with more steps than a scenario allows.
    """
    stimuli = sorted(_stimuli(system, history, wanted), key=lambda s: s.t_ns)
    steps = list(_steps(system, history, wanted, stimuli))
    if not any("expect:" in step for step in steps):
        raise UsageError("this run has nothing to expect", expected="a trace with values or states")
    if len(steps) > MOST_STEPS:
        raise UsageError(
            "the run is too long for a scenario",
            expected=f"at most {MOST_STEPS:,} steps",
            got=f"{len(steps):,}",
        )
    lines = [
        f"# Made from {wanted.source or 'a run'}: its inputs, and their effects. It can be edited like any scenario.",
        f"scenario: {json.dumps(wanted.name, ensure_ascii=False)}",
        f"system: {json.dumps(wanted.system)}",
    ]
    lines += [f"seed: {wanted.seed}"] if wanted.seed is not None else []
    return "\n".join([*lines, "steps:", *(f"  - {step}" for step in steps), ""])


def _faults(history: RunHistory) -> Iterator[_Stimulus]:
    """Yield the steps that start and end faults, with all parameters of the faults."""
    for event in history.faults:
        if not event.data.get("on"):
            yield _Stimulus(event.t_ns, f"clear: {json.dumps(event.where)}")
        else:
            said = {**event.data.get("said", {"name": event.data.get("name")}), "id": event.where}
            yield _Stimulus(event.t_ns, f"fault: {json.dumps(said, ensure_ascii=False)}")


def _stimuli(system: System, history: RunHistory, wanted: ScenarioOptions) -> Iterator[_Stimulus]:
    for came in history.commands:
        try:
            yield _Stimulus(came.t_ns, f"send: {{period_s: {decode_period(COMMAND(came.payload))}}}")
        except FieldtwinError:
            continue  # a scenario cannot send this command, but its effects are still expected
    yield from _faults(history)
    if not wanted.values:
        return
    for name, changes in sorted(history.tags.items()):
        device, _, tag = name.partition(".")
        config = system.devices.get(device)
        if config is None or config.profile.inbox is not None or tag in config.writable:
            continue
        for change in changes:
            value, quality = change.says()
            if quality in ("good", "") and isinstance(value, bool | int | float):
                yield _Stimulus(change.t_ns, f"set: {{tag: {name}, value: {json.dumps(value)}}}")


def _steps(system: System, history: RunHistory, wanted: ScenarioOptions, stimuli: list[_Stimulus]) -> Iterator[str]:
    """Yield the stimuli with the pauses and expectations between them. An expectation may take as long as in the run."""
    now_ns = 0
    last_ns = max(0, history.end_ns - STOPPING_NS)
    bounds = [*(s.t_ns for s in stimuli), last_ns]
    for n in range(-1, len(stimuli)):
        begin_ns = stimuli[n].t_ns if n >= 0 else 0
        if n >= 0:
            if begin_ns > now_ns:
                yield f"pause: {_s(begin_ns - now_ns)}"
            now_ns = begin_ns
            yield stimuli[n].step
        end_ns = bounds[n + 1]
        for t_ns, step in sorted(_seen(history, wanted, begin_ns, end_ns)):
            if t_ns > now_ns:
                yield (
                    f"pause: {_s(t_ns - now_ns)}"
                    if step.startswith("#")
                    else step.replace("WITHIN", _s(t_ns - now_ns, wanted))
                )
                now_ns = t_ns
            else:
                yield step.replace("WITHIN", _s(0, wanted))
        look_ns = end_ns - AHEAD_NS
        if look_ns - max(now_ns, begin_ns) > AHEAD_NS:
            yield f"pause: {_s(look_ns - now_ns)}"
            now_ns = look_ns
            yield from _looks(
                system, history, wanted, begin_ns, look_ns
            )  # the expectations of the fields that changed; at the end, those of all fields


def _seen(history: RunHistory, wanted: ScenarioOptions, begin_ns: int, end_ns: int) -> Iterator[tuple[int, str]]:
    """Yield (time in ns, expectation) for each value of a program's variable that lasted long enough to be observed."""
    for name, changes in history.states.items():
        for n, change in enumerate(changes):
            until_ns = changes[n + 1].t_ns if n + 1 < len(changes) else history.end_ns
            inside = begin_ns <= change.t_ns < end_ns - AHEAD_NS
            if inside and until_ns - change.t_ns >= BRIEF_NS and isinstance(change.value, str | bool):
                yield (
                    change.t_ns,
                    f"expect: {{that: {json.dumps(f'{name} == {_literal(change.value)}')}, within: WITHIN}}",
                )


def _looks(system: System, history: RunHistory, wanted: ScenarioOptions, begin_ns: int, look_ns: int) -> Iterator[str]:
    """Yield the expectations at the end of a period: for numbers of programs, and for tags (a value or the device's register)."""
    within = f"within: {_s(0, wanted)}"
    last = look_ns >= history.end_ns - STOPPING_NS - AHEAD_NS

    def rested(changes: list[ValueChange]) -> bool:
        return not last and not any(begin_ns <= c.t_ns <= look_ns for c in changes)

    for name, changes in sorted(history.states.items()):
        now = _at(changes, look_ns)
        if rested(changes):
            continue
        if now is not None and isinstance(now.value, int | float) and not isinstance(now.value, bool):
            if "." in name and name.partition(".")[0] in system.devices:
                continue  # an output that a device holds is also a tag, which is checked as such
            slack = _slack(changes, history)
            about = f"{name} == {_literal(now.value)}"
            if slack:
                about = f"{name} >= {_literal(now.value - slack)} and {name} <= {_literal(now.value + slack)}"
            yield f"expect: {{that: {json.dumps(about)}, {within}}}"
    for name, changes in sorted(history.tags.items()):
        now = _at(changes, look_ns)
        if now is None or rested(changes):
            continue
        value, quality = now.says()
        device, _, tag = name.partition(".")
        counts = device in system.devices and system.devices[device].profile.tags[tag].counter
        said = [f"tag: {name}", *([f"quality: {quality}"] if quality else [])]
        restless = sum(begin_ns <= c.t_ns <= look_ns for c in changes) > RESTLESS
        if quality in ("good", "") and restless:
            size: float = max((abs(c.value) for c in changes if isinstance(c.value, int | float)), default=0.0)
            tolerance = max(wanted.share * size, _slack(changes, history, counts=counts))
            said += ["like: recording", f"tolerance: {_number(tolerance)}"]
        elif isinstance(value, bool | str):
            said += [f"value: {json.dumps(value)}"]
        elif isinstance(value, int | float) and not restless:
            said += [f"value: {_literal(value)}"]
            share = wanted.share * abs(value) if isinstance(value, float) else 0
            tolerance = max(share, _slack(changes, history, counts=counts))
            said += [f"tolerance: {_number(tolerance)}"] if tolerance else []
        yield f"expect: {{{', '.join(said)}, {within}}}"


def _slack(changes: list[ValueChange], history: RunHistory, *, counts: bool = False) -> float:
    """Return the tolerance for a field whose value may change between its recording and its check: its largest step, and
    at least 2 if the field is a counter of its device (`counts`).

    0 for a field that only commands change: its value is known exactly.
    """
    numbers = [c.value for c in changes if isinstance(c.value, int | float) and not isinstance(c.value, bool)]
    if len(changes) <= len(history.commands) + 2 and not counts:
        return 0
    steps = [abs(b - a) for a, b in pairwise(numbers)]
    return max([*steps, 2.0 if counts else 0.0])


def _at(changes: list[ValueChange], t_ns: int) -> ValueChange | None:
    place = bisect_right([change.t_ns for change in changes], t_ns)
    return changes[place - 1] if place else None


def _literal(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    return f"'{value}'" if isinstance(value, str) else repr(as_decimal(value))


def _number(value: float) -> str:
    return f"{value:.6g}"


def _s(ns: int, wanted: ScenarioOptions | None = None) -> str:
    return f"{(ns / NS_PER_S + (wanted.window_s if wanted else 0.0)):.3f}".rstrip("0").rstrip(".") + "s"
