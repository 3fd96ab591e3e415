"""Check the sequential function charts of a POU: names, steps, qualifiers, and the steps that can be reached.

The types of conditions, times and indicator variables are checked when the translated chart is compiled.
"""

from __future__ import annotations

from fieldtwin.gateway.core.files.error_collector import ErrorCollector
from fieldtwin.gateway.core.files.nearest import did_you_mean
from fieldtwin.plc.st.charts.reachability import check_reachability
from fieldtwin.plc.st.syntax import tree as t
from fieldtwin.plc.st.syntax.errors import invalid
from fieldtwin.plc.st.syntax.walk import nodes

TIMED = ("L", "D", "SD", "DS", "SL")
"""The qualifiers that have a time."""
_QUALIFIERS = ("N", "R", "S", "P", "P0", "P1", *TIMED)


def charts_of(pou: t.Pou) -> dict[str, t.Chart]:
    """Return the charts of a POU by the names of their actions. The name of the chart that is its body is ""."""
    found = {"": pou.chart, **{action.name: action.chart for action in pou.actions}}
    return {name: chart for name, chart in found.items() if chart is not None}


def check_charts(pou: t.Pou, found: ErrorCollector) -> None:
    """Add an error to `found` for each part of a chart of `pou` that is wrong."""
    bodies = {"": pou.body, **{action.name: action.body for action in pou.actions}}
    charts = charts_of(pou)
    steps = {step.name.lower() for chart in charts.values() for step in chart.steps}
    for one in nodes(pou.actions):
        if isinstance(one, t.Call) and one.ref.name.lower() in steps:
            found.add(invalid(one.pos, f"step {one.ref.name} cannot be called", hint="a transition activates a step"))
    _check_names(pou, charts, found)
    for name, chart in charts.items():
        if bodies[name]:
            found.add(invalid(bodies[name][0].pos, "a statement next to steps", hint="put it into an ACTION"))
        _check(f"{pou.name}.{name}" if name else pou.name, chart, found)


def indicators(one: t.Association) -> tuple[t.Expr, ...]:
    """Return the indicator variables of an action of a step."""
    return one.arguments[one.qualifier in TIMED :]


def _check_names(pou: t.Pou, charts: dict[str, t.Chart], found: ErrorCollector) -> None:
    """Check that the names of steps and of transitions with a body are unique, and that each action is in one chart only."""
    seen: set[str] = set()
    taken = {v.name.lower() for block in pou.blocks for v in block.variables} | {a.name.lower() for a in pou.actions}
    of: dict[str, str] = {}
    for name, chart in charts.items():
        for step in chart.steps:
            if step.name.lower() in seen:
                found.add(invalid(step.pos, f"step {step.name} is declared twice"))
            seen.add(step.name.lower())
            for one in step.associations:
                if of.setdefault(one.action.lower(), name) != name:
                    message = f"action {one.action} belongs to steps of two charts of {pou.name}"
                    found.add(invalid(one.pos, message, hint="one chart can set a variable that the other reads"))
    for chart in charts.values():
        for transition in chart.transitions:
            if transition.body and transition.name.lower() in taken | seen:
                hint = "its body assigns the condition to the name of the transition"
                found.add(invalid(transition.pos, f"transition {transition.name} has a name that is used", hint=hint))


def _check(of: str, chart: t.Chart, found: ErrorCollector) -> None:
    for step in chart.steps:
        for one in step.associations:
            _check_association(one, found)
        _check_twice(step, found)
    initial = [step for step in chart.steps if step.initial]
    if not initial:
        pos = (chart.steps or chart.transitions)[0].pos
        found.add(invalid(pos, f"the chart of {of} has no initial step", "one INITIAL_STEP"))
    for step in initial[1:]:
        message = f"{step.name} is a second initial step; the first is {initial[0].name}"
        found.add(invalid(step.pos, message, "one INITIAL_STEP"))
    known = [step.name for step in chart.steps]
    names = {name.lower() for name in known}
    complete = len(initial) == 1 and len(names) == len(known)
    for transition in chart.transitions:
        for name in (*transition.sources, *transition.targets):
            if name.lower() not in names:
                complete = False
                message = f"step {name!r} is not declared"
                found.add(invalid(transition.pos, message, hint=did_you_mean(name, known)))
        for one in nodes(transition.body):
            if isinstance(one, t.Jump) and one.word in ("RETURN", "JMP"):
                found.add(invalid(one.pos, f"{one.word} in the body of a transition", hint="use IF and ELSE"))
    if complete:
        for error in check_reachability(chart):
            found.add(error)


def _check_twice(step: t.Step, found: ErrorCollector) -> None:
    seen: set[tuple[str, str]] = set()
    for one in step.associations:
        if (one.action.lower(), one.qualifier) in seen:
            message = f"step {step.name} has action {one.action} twice with the qualifier {one.qualifier}"
            found.add(invalid(one.pos, message))
        seen.add((one.action.lower(), one.qualifier))


def _check_association(one: t.Association, found: ErrorCollector) -> None:
    if one.qualifier not in _QUALIFIERS:
        found.add(invalid(one.pos, f"the qualifier of action {one.action}", ", ".join(_QUALIFIERS), one.qualifier))
    elif one.qualifier in TIMED and not one.arguments:
        found.add(invalid(one.pos, f"action {one.action} has no time", f"{one.action}({one.qualifier}, T#1s)"))
    for indicator in indicators(one):
        if not isinstance(indicator, t.Ref):
            message = f"the indicator of action {one.action} is not a variable"
            found.add(invalid(indicator.pos, message, "the name of a BOOL variable"))
