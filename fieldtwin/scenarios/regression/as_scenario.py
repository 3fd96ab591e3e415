"""A recorded run as a scenario: what came in becomes its stimuli, what followed its expectations, with tolerance and window.

Stimuli are the commands of the far end, faults and, where asked for, what devices said; the emulators of the scenario's prototype
play their recordings by themselves. Pure: a `Story` in, text out.
"""

from __future__ import annotations

import json
from bisect import bisect_right
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.errors import FieldtwinError, UsageError
from fieldtwin.gateway.core.statemachine import decode_period
from fieldtwin.gateway.core.values import COMMAND
from fieldtwin.scenarios.regression.run_history import Change, Story
from fieldtwin.twin.site.system import System

BRIEF_NS = 200_000_000
"""A state that lasted less is not waited for: a check might come too late for it."""
RESTLESS = 3
"""A tag that changes more often between two stimuli is compared with what its device holds, not with one value."""
MOST_STEPS = 5_000
AHEAD_NS = 200_000_000
"""Tags are looked at so long before the next stimulus."""
STOPPING_NS = 2 * NS_PER_S
"""The end of a run is its outputs being made safe and its devices leaving: nothing that is expected again."""


@dataclass(frozen=True)
class Wanted:
    """How the scenario is to be. `share` of a value is its tolerance, `window_s` how long after its time something may come.
    `values`: what devices said is set, too (for a prototype that plays something else)."""

    name: str
    system: str
    """As the scenario file names it."""
    share: float = 0.01
    window_s: float = 1.0
    seed: int | None = None
    values: bool = False
    source: str = ""


@dataclass(frozen=True)
class _Stimulus:
    t_ns: int
    step: str


def as_scenario(system: System, story: Story, wanted: Wanted) -> str:
    """The scenario file. Raises `UsageError` for a run of which nothing can be expected, or with more than a scenario takes."""
    stimuli = sorted(_stimuli(system, story, wanted), key=lambda s: s.t_ns)
    steps = list(_steps(system, story, wanted, stimuli))
    if not any("expect:" in step for step in steps):
        raise UsageError("nothing in this run can be expected again", expected="a trace with values or states")
    if len(steps) > MOST_STEPS:
        raise UsageError("too long for a scenario", expected=f"at most {MOST_STEPS:,} steps", got=f"{len(steps):,}")
    lines = [
        f"# Made from {wanted.source or 'a run'}: what came in, and what followed. Edit it: it is a scenario like others.",
        f"scenario: {json.dumps(wanted.name, ensure_ascii=False)}",
        f"system: {json.dumps(wanted.system)}",
    ]
    lines += [f"seed: {wanted.seed}"] if wanted.seed is not None else []
    return "\n".join([*lines, "steps:", *(f"  - {step}" for step in steps), ""])


def _faults(story: Story) -> Iterator[_Stimulus]:
    """Faults put in and taken away, with all that was said of them."""
    for event in story.faults:
        if not event.data.get("on"):
            yield _Stimulus(event.t_ns, f"clear: {json.dumps(event.where)}")
        else:
            said = {**event.data.get("said", {"name": event.data.get("name")}), "id": event.where}
            yield _Stimulus(event.t_ns, f"fault: {json.dumps(said, ensure_ascii=False)}")


def _stimuli(system: System, story: Story, wanted: Wanted) -> Iterator[_Stimulus]:
    for came in story.commands:
        try:
            yield _Stimulus(came.t_ns, f"send: {{period_s: {decode_period(COMMAND(came.payload))}}}")
        except FieldtwinError:
            continue  # no command that a scenario can send: what the system made of it is expected all the same
    yield from _faults(story)
    if not wanted.values:
        return
    for name, changes in sorted(story.tags.items()):
        device, _, tag = name.partition(".")
        config = system.devices.get(device)
        if config is None or config.profile.inbox is not None or tag in config.writable:
            continue
        for change in changes:
            value, quality = change.says()
            if quality in ("good", "") and isinstance(value, bool | int | float):
                yield _Stimulus(change.t_ns, f"set: {{tag: {name}, value: {json.dumps(value)}}}")


def _steps(system: System, story: Story, wanted: Wanted, stimuli: list[_Stimulus]) -> Iterator[str]:
    """Time goes by in pauses; an expectation that is met in time takes as long as it did in the run."""
    now_ns = 0
    last_ns = max(0, story.end_ns - STOPPING_NS)
    bounds = [*(s.t_ns for s in stimuli), last_ns]
    for n in range(-1, len(stimuli)):
        begin_ns = stimuli[n].t_ns if n >= 0 else 0
        if n >= 0:
            if begin_ns > now_ns:
                yield f"pause: {_s(begin_ns - now_ns)}"
            now_ns = begin_ns
            yield stimuli[n].step
        end_ns = bounds[n + 1]
        for t_ns, step in sorted(_seen(story, wanted, begin_ns, end_ns)):
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
                system, story, wanted, begin_ns, look_ns
            )  # of what has moved; of all that there is at the end


def _seen(story: Story, wanted: Wanted, begin_ns: int, end_ns: int) -> Iterator[tuple[int, str]]:
    """What programs said in between, that lasted long enough to be seen."""
    for name, changes in story.states.items():
        for n, change in enumerate(changes):
            until_ns = changes[n + 1].t_ns if n + 1 < len(changes) else story.end_ns
            inside = begin_ns <= change.t_ns < end_ns - AHEAD_NS
            if inside and until_ns - change.t_ns >= BRIEF_NS and isinstance(change.value, str | bool):
                yield (
                    change.t_ns,
                    f"expect: {{that: {json.dumps(f'{name} == {_literal(change.value)}')}, within: WITHIN}}",
                )


def _looks(system: System, story: Story, wanted: Wanted, begin_ns: int, look_ns: int) -> Iterator[str]:
    """What everything is at the end of such a time: numbers of programs, tags by value, or like what their device holds."""
    within = f"within: {_s(0, wanted)}"
    last = look_ns >= story.end_ns - STOPPING_NS - AHEAD_NS

    def rested(changes: list[Change]) -> bool:
        return not last and not any(begin_ns <= c.t_ns <= look_ns for c in changes)

    for name, changes in sorted(story.states.items()):
        now = _at(changes, look_ns)
        if rested(changes):
            continue
        if now is not None and isinstance(now.value, int | float) and not isinstance(now.value, bool):
            if "." in name and name.partition(".")[0] in system.devices:
                continue  # an output that a device holds is a tag as well
            slack = _slack(changes, story)
            about = f"{name} == {_literal(now.value)}"
            if slack:
                about = f"{name} >= {_literal(now.value - slack)} and {name} <= {_literal(now.value + slack)}"
            yield f"expect: {{that: {json.dumps(about)}, {within}}}"
    for name, changes in sorted(story.tags.items()):
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
            tolerance = max(wanted.share * size, _slack(changes, story, counts=counts))
            said += ["like: recording", f"tolerance: {_number(tolerance)}"]
        elif isinstance(value, bool | str):
            said += [f"value: {json.dumps(value)}"]
        elif isinstance(value, int | float) and not restless:
            said += [f"value: {_literal(value)}"]
            share = wanted.share * abs(value) if isinstance(value, float) else 0
            tolerance = max(share, _slack(changes, story, counts=counts))
            said += [f"tolerance: {_number(tolerance)}"] if tolerance else []
        yield f"expect: {{{', '.join(said)}, {within}}}"


def _slack(changes: list[Change], story: Story, *, counts: bool = False) -> float:
    """How far a field that moves by itself may have got meanwhile: its largest step, of what `counts` in its device two at
    least. 0 for one that commands alone have changed: that one is known exactly."""
    numbers = [c.value for c in changes if isinstance(c.value, int | float) and not isinstance(c.value, bool)]
    if len(changes) <= len(story.commands) + 2 and not counts:
        return 0
    steps = [abs(b - a) for a, b in pairwise(numbers)]
    return max([*steps, 2.0 if counts else 0.0])


def _at(changes: list[Change], t_ns: int) -> Change | None:
    place = bisect_right([change.t_ns for change in changes], t_ns)
    return changes[place - 1] if place else None


def _literal(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    return f"'{value}'" if isinstance(value, str) else repr(value)


def _number(value: float) -> str:
    return f"{value:.6g}"


def _s(ns: int, wanted: Wanted | None = None) -> str:
    return f"{(ns / NS_PER_S + (wanted.window_s if wanted else 0.0)):.3f}".rstrip("0").rstrip(".") + "s"
