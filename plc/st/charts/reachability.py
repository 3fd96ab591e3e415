"""Find the steps and transitions of a sequential function chart that no run can reach (IEC 61131-3:2013, 6.7.6).

The search follows every set of steps that can be active together, with any results of the conditions. A chart is unsafe if a
transition activates a step that is already active, because one activation of the step is then lost.
"""

from __future__ import annotations

from collections.abc import Iterator

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.plc.st.syntax import tree as t
from fieldtwin.plc.st.syntax.errors import invalid

MAX_SITUATIONS = 5_000
"""The largest number of sets of active steps that are examined; a larger chart is not checked."""


def check_reachability(chart: t.Chart) -> Iterator[FileInvalid]:
    """Yield an error for each step that is never active, each transition that is never enabled, and for an unsafe chart.

    The chart has to have one initial step and no unknown steps.
    """
    moves = [
        (one, frozenset(map(str.lower, one.sources)), frozenset(map(str.lower, one.targets)))
        for one in chart.transitions
    ]
    start = frozenset(step.name.lower() for step in chart.steps if step.initial)
    seen, pending, enabled = {start}, [start], set()
    while pending:
        active = pending.pop()
        for number, (one, sources, targets) in enumerate(moves):
            if not sources <= active:
                continue
            enabled.add(number)
            rest = active - sources
            if rest & targets:
                yield invalid(
                    one.pos, f"the transition activates {_names(chart, rest & targets)}, which can already be active"
                )
                return
            after = rest | targets
            if after not in seen:
                if len(seen) == MAX_SITUATIONS:
                    return
                seen.add(after)
                pending.append(after)
    reached = frozenset().union(*seen)
    for step in chart.steps:
        if step.name.lower() not in reached:
            yield invalid(step.pos, f"step {step.name} cannot be reached from the initial step")
    for number, (one, sources, _) in enumerate(moves):
        if number not in enabled and sources <= reached:
            yield invalid(
                one.pos, f"{_names(chart, sources)} can never be active together, so the transition is never enabled"
            )


def _names(chart: t.Chart, steps: frozenset[str]) -> str:
    return ", ".join(step.name for step in chart.steps if step.name.lower() in steps)
