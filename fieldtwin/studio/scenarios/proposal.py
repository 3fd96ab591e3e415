"""Turn a recording of Studio into the text of a scenario file with proposed expectations. No file is read or written.

The actions become steps, with the pauses between them. After each action the file expects what was observed until the next
one: tags that turned bad, with the reason, tags that became good again, values that were set in a device, and states that
programs reached.
"""

from __future__ import annotations

import json
import math
from bisect import bisect_right
from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import Any, NamedTuple, TypeVar

from fieldtwin.gateway.core.conditions.decimals import as_decimal
from fieldtwin.gateway.runtime.alarms.state_machine import ACKNOWLEDGEABLE
from fieldtwin.studio.scenarios.recorder import Action, Recording, Seen, State

BRIEF_NS = 500_000_000
"""A state or quality that lasted less than this (ns) is not expected, because a check could miss it by chance."""
MOST_OF_A_PERIOD = 40
"""Largest number of expectations after one action."""
RESTLESS = 3
"""A tag whose quality changes more often than this after one action is not expected to have a certain quality."""
SLACK_S = 4.0
"""An effect may take twice the observed time plus this many seconds, because the phase of the polls differs in each run."""
RECOVERY_SLACK_S = 10.0
"""The same for a tag that becomes good again, because the gateway retries a lost device at growing intervals."""
KNOWN_WITHIN_S = 60

T = TypeVar("T", Seen, State)


class _Expected(NamedTuple):
    t_ns: int
    step: str
    comment: str
    slack_s: float = SLACK_S


def as_scenario(recording: Recording, name: str, system: str) -> str:
    """Return the scenario file. `system` is the value of its key `system`."""
    expected = [list(_expected(recording, n)) for n in range(len(recording.actions))]
    return "\n".join(
        [
            "# Recorded in Studio: the actions on the simulated devices, and the observations after them.",
            "# Studio proposes the expectations. Delete those that do not matter, and write down those that do: a rule under",
            "# `always`, such as \"quality(DEVICE.TAG) != 'good' or age(DEVICE.TAG) <= 2.5 s\", is checked all the time.",
            *(["# The recording is incomplete: it had too many changes."] if recording.is_full else []),
            f"scenario: {json.dumps(name, ensure_ascii=False)}",
            f"system: {json.dumps(system, ensure_ascii=False)}",
            "steps:",
            *_steps(recording, expected),
            "",
        ]
    )


def _steps(recording: Recording, expected: list[list[_Expected]]) -> Iterator[str]:
    yield "  # The scenario restarts the system; the recording began with these states and values."
    yield from _beginning(recording)
    now_ns = recording.begin_ns
    for n, action in enumerate(recording.actions):
        if action.t_ns - now_ns > BRIEF_NS:
            yield f"  - pause: {_s(action.t_ns - now_ns)}"
        now_ns = max(now_ns, action.t_ns)
        yield ""
        yield f"  # {_since(recording, action.t_ns)}: {_line(action.said)}"
        if action.step is None:
            yield "  # A scenario has no step for this, so it may behave differently."
        elif _never_read(recording, n):
            yield "  # Left out: the gateway did not read the set value before it was released."
        else:
            if "acknowledge" in action.step:
                yield f"  - wait: {{until: {json.dumps(_to_acknowledge(action.step['acknowledge']))}, within: {KNOWN_WITHIN_S}s}}"
            yield f"  - {_flow(action.step)}"
        for one in expected[n][:MOST_OF_A_PERIOD]:
            within = math.ceil(2 * (one.t_ns - now_ns) / 1e9 + one.slack_s)
            yield f"  - expect: {{{one.step}, within: {within}s}}  # {one.comment}"
            now_ns = max(now_ns, one.t_ns)
        if len(expected[n]) > MOST_OF_A_PERIOD:
            yield f"  # {len(expected[n]) - MOST_OF_A_PERIOD} more changes were observed."
    if not any(expected):
        yield "  # Nothing was observed to change: without an expectation, the scenario is inconclusive."


def _beginning(recording: Recording) -> Iterator[str]:
    """Yield a `wait` step for each program's first state, and for each tag that is expected later and was good at first."""
    for name, states in sorted(recording.states.items()):
        first = _at(states, recording.begin_ns) or (states[0] if states else None)
        if first is not None:
            yield f"  - wait: {{until: {json.dumps(f'{name} == {first.word!r}')}, within: {KNOWN_WITHIN_S}s}}"
    for name in sorted(recording.tags):
        changes = any(_changed(recording, name, n) for n in range(len(recording.actions)))
        if changes and _good_at_first(recording, name):
            about = f"quality({name}) == 'good'"
            yield f"  - wait: {{until: {json.dumps(about)}, within: {KNOWN_WITHIN_S}s}}"


def _expected(recording: Recording, n: int) -> Iterator[_Expected]:
    """Yield the expectations for what was observed between action `n` and the next one, in order of time."""
    found = [one for name in sorted(recording.tags) if (one := _changed(recording, name, n)) is not None]
    found += _reached(recording, n)
    yield from sorted(found, key=lambda one: one.t_ns)


def _changed(recording: Recording, name: str, n: int) -> _Expected | None:
    """Return the expectation for a tag that turned bad or good after action `n`, or whose value was set; None if neither."""
    begin_ns, end_ns = _period(recording, n)
    changes = recording.tags[name]
    before, after = _at(changes, begin_ns), _at(changes, end_ns)
    inside = [change for change in changes if begin_ns < change.t_ns <= end_ns]
    if before is None or after is None or not inside:
        return None
    told = _told(recording.actions[n])
    if told is not None and told["tag"] == name and told["value"] is not None:
        return _held(name, inside[-1], begin_ns)
    turns = sum(a.quality != b.quality for a, b in pairwise([before, *inside]))
    since_ns = _since_quality(inside, after)
    if not _good_at_first(recording, name) or turns > RESTLESS:
        return None
    if end_ns - since_ns < BRIEF_NS or after.quality == before.quality:
        return None
    if after.quality == "bad":
        reason = after.reason.replace(" ", "_")  # as expressions write it
        about = f"quality({name}) == 'bad' and reason({name}) == {reason!r}"
        return _Expected(since_ns, f"that: {json.dumps(about)}", _delay(since_ns - begin_ns))
    step = f"tag: {name}, quality: {after.quality}"
    return _Expected(since_ns, step, _delay(since_ns - begin_ns), RECOVERY_SLACK_S)


def _good_at_first(recording: Recording, name: str) -> bool:
    """Return whether a tag was good when the recording began; others have no known value that could turn bad."""
    first = _at(recording.tags[name], recording.begin_ns)
    return first is not None and first.quality == "good"


def _held(name: str, seen: Seen, begin_ns: int) -> _Expected | None:
    """Return the expectation for a value that was set, as the gateway read it, rounded by the register's resolution."""
    if seen.quality != "good" or not isinstance(seen.value, bool | int | float):
        return None
    tolerance = f", tolerance: {abs(seen.value) * 1e-6:.3g}" if isinstance(seen.value, float) and seen.value else ""
    step = f"tag: {name}, value: {json.dumps(as_decimal(seen.value))}{tolerance}, quality: good"
    return _Expected(seen.t_ns, step, _delay(seen.t_ns - begin_ns))


def _never_read(recording: Recording, n: int) -> bool:
    """Return whether action `n` sets a value that was released before the gateway read it, or is that release.

    A scenario fails if a `set` takes no effect.
    """
    told = _told(recording.actions[n])
    if told is None:
        return False
    same = [k for k, action in enumerate(recording.actions) if (_told(action) or {}).get("tag") == told["tag"]]
    place = same.index(n)
    if told["value"] is None:
        return place > 0 and _never_read(recording, same[place - 1])
    begin_ns = recording.actions[n].t_ns
    end_ns = recording.actions[same[place + 1]].t_ns if place + 1 < len(same) else recording.end_ns
    changes = recording.tags.get(told["tag"], [])
    before = _at(changes, begin_ns)
    return (before is None or before.value != told["value"]) and not any(begin_ns < c.t_ns <= end_ns for c in changes)


def _told(action: Action) -> dict[str, Any] | None:
    told: dict[str, Any] | None = (action.step or {}).get("set")
    return told


def _to_acknowledge(alarm: str) -> str:
    """Return the expression in which an alarm can be acknowledged."""
    return " or ".join(f"{alarm} == {state.value!r}" for state in ACKNOWLEDGEABLE)


def _delay(ns: int) -> str:
    return f"observed after {ns / 1e9:.1f} s"


def _reached(recording: Recording, n: int) -> Iterator[_Expected]:
    begin_ns, end_ns = _period(recording, n)
    for name, states in sorted(recording.states.items()):
        for place, state in enumerate(states):
            until_ns = states[place + 1].t_ns if place + 1 < len(states) else recording.end_ns
            if begin_ns < state.t_ns <= end_ns and until_ns - state.t_ns >= BRIEF_NS:
                about = json.dumps(f"{name} == {state.word!r}")
                yield _Expected(state.t_ns, f"that: {about}", _delay(state.t_ns - begin_ns))


def _period(recording: Recording, n: int) -> tuple[int, int]:
    """Return begin and end (ns) of the period from action `n` to the next action, or to the end of the recording."""
    actions = recording.actions
    return actions[n].t_ns, actions[n + 1].t_ns if n + 1 < len(actions) else recording.end_ns


def _since_quality(inside: list[Seen], after: Seen) -> int:
    """Return the time in ns since which the tag had its last quality and reason without interruption."""
    since_ns = after.t_ns
    for change in reversed(inside):
        if (change.quality, change.reason) != (after.quality, after.reason):
            break
        since_ns = change.t_ns
    return since_ns


def _at(changes: Sequence[T], t_ns: int) -> T | None:
    place = bisect_right([change.t_ns for change in changes], t_ns)
    return changes[place - 1] if place else None


def _flow(step: dict[str, Any]) -> str:
    """Return a step on one line: YAML with its content as JSON."""
    [(word, what)] = step.items()
    return f"{word}: {json.dumps(what, ensure_ascii=False)}"


def _since(recording: Recording, t_ns: int) -> str:
    return f"{(t_ns - recording.begin_ns) / 1e9:.1f} s"


def _line(text: str) -> str:
    """Return `text` on one line, so that it stays within a YAML comment."""
    return " ".join(text.split())[:200]


def _s(ns: int) -> str:
    return f"{ns / 1e9:.1f}s"
