"""Translate sequential function charts (IEC 61131-3:2013, 6.7) into statements and function blocks of the tree.

Each step becomes an instance of a function block with the outputs X and T, and each action an instance of the standard's
ACTION_CONTROL (6.7.4.6). So inspection, virtual time and skipped scans need no special case for a chart.
Names that begin with 0 belong to this translation; no source can contain them.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

from fieldtwin.gateway.core.files.error_collector import ErrorCollector
from fieldtwin.plc.st.charts.check import TIMED, charts_of, check_charts, indicators
from fieldtwin.plc.st.classes.readable import READABLE
from fieldtwin.plc.st.syntax import tree as t
from fieldtwin.plc.st.syntax.parse import parse
from fieldtwin.plc.st.syntax.walk import nodes, with_parts

_HIDDEN = "hidden_"
STEP = "0step"
"""The name of the function block of a step."""
_BLOCKS = """
FUNCTION_BLOCK hidden_chart VAR_INPUT hidden_started : BOOL; END_VAR END_FUNCTION_BLOCK
FUNCTION_BLOCK hidden_step
VAR_INPUT hidden_lost, hidden_gained, hidden_time_only : BOOL; END_VAR
VAR_OUTPUT X : BOOL; T : TIME; hidden_rise, hidden_fall : BOOL; END_VAR
VAR hidden_now : BOOL; hidden_timer : TON; END_VAR
  IF hidden_time_only THEN
    hidden_timer(IN := X, PT := T#100000d);
    IF X THEN T := hidden_timer.ET; END_IF
    RETURN;
  END_IF
  hidden_now := (X AND NOT hidden_lost) OR hidden_gained;
  hidden_rise := hidden_now AND NOT X;
  hidden_fall := X AND NOT hidden_now;
  X := hidden_now;
  hidden_timer(IN := X, PT := T#100000d);
  IF X THEN T := hidden_timer.ET; END_IF
END_FUNCTION_BLOCK
FUNCTION_BLOCK hidden_action_control
VAR_INPUT
  hidden_n, hidden_r, hidden_s, hidden_l, hidden_d, hidden_p, hidden_p0, hidden_p1, hidden_sd, hidden_ds, hidden_sl : BOOL;
  hidden_t_l, hidden_t_d, hidden_t_sd, hidden_t_ds, hidden_t_sl : TIME;
END_VAR
VAR_OUTPUT hidden_q, hidden_a : BOOL; END_VAR
VAR
  hidden_s_ff, hidden_sd_ff, hidden_ds_ff, hidden_sl_ff : RS;
  hidden_l_tmr, hidden_d_tmr, hidden_sd_tmr, hidden_ds_tmr, hidden_sl_tmr : TON;
  hidden_steady, hidden_before : BOOL;
END_VAR
  hidden_before := hidden_steady;
  hidden_s_ff(S := hidden_s, R1 := hidden_r);
  hidden_l_tmr(IN := hidden_l, PT := hidden_t_l);
  hidden_d_tmr(IN := hidden_d, PT := hidden_t_d);
  hidden_sd_ff(S := hidden_sd, R1 := hidden_r);
  hidden_sd_tmr(IN := hidden_sd_ff.Q1, PT := hidden_t_sd);
  hidden_ds_tmr(IN := hidden_ds, PT := hidden_t_ds);
  hidden_ds_ff(S := hidden_ds_tmr.Q, R1 := hidden_r);
  hidden_sl_ff(S := hidden_sl, R1 := hidden_r);
  hidden_sl_tmr(IN := hidden_sl_ff.Q1, PT := hidden_t_sl);
  hidden_steady := NOT hidden_r AND (hidden_n OR hidden_s_ff.Q1 OR (hidden_l AND NOT hidden_l_tmr.Q) OR hidden_d_tmr.Q
    OR hidden_p OR hidden_sd_tmr.Q OR hidden_ds_ff.Q1 OR (hidden_sl_ff.Q1 AND NOT hidden_sl_tmr.Q));
  hidden_q := hidden_steady OR (NOT hidden_r AND (hidden_p0 OR hidden_p1));
  hidden_a := hidden_q OR (hidden_before AND NOT hidden_steady);
END_FUNCTION_BLOCK
"""
"""The function blocks of charts, steps and actions. An action is executed a last time in the scan in which its Q becomes FALSE,
except after P0 and P1, which execute it in one scan (decision 0059)."""


def is_hidden(name: str) -> bool:
    """Return whether the name belongs to the translation of a chart or a drawing, not to the source."""
    return name.startswith("0")


def without_charts(unit: t.SourceUnit) -> t.SourceUnit:
    """Return `unit` with the charts of its POUs and of their actions as statements.

    Raises `FileInvalid` with line and column for the first error of a chart, and with the others.
    """
    if not any(charts_of(pou) for pou in unit.pous):
        return unit
    found = ErrorCollector()
    for pou in unit.pous:
        check_charts(pou, found)
    found.raise_all()
    shared = frozenset(v.name.lower() for block in unit.globals for v in block.variables)
    pous = tuple(_without_charts(pou, shared) if charts_of(pou) else pou for pou in unit.pous)
    return replace(unit, pous=(*_blocks(), *pous))


def _without_charts(pou: t.Pou, shared: frozenset[str]) -> t.Pou:
    """Return a POU with its charts as statements. `shared` are the names of global variables, in lower case."""
    parts = {name: _Translation(pou, name, chart, shared) for name, chart in charts_of(pou).items()}
    variables = tuple(one for part in parts.values() for one in part.variables())
    access = frozenset({"PUBLIC"}) if READABLE in pou.modifiers else frozenset()
    block = t.VarBlock(pou.pos, "VAR", access, variables)
    actions = tuple(
        replace(action, body=parts[action.name].body(), chart=None) if action.name in parts else action
        for action in pou.actions
    )
    body = parts[""].body() if "" in parts else pou.body
    return replace(pou, blocks=(*pou.blocks, block), body=body, actions=actions, chart=None)


class _Translation:
    """The translation of one chart: the body of a POU, or of its action `name`."""

    def __init__(self, pou: t.Pou, name: str, chart: t.Chart, shared: frozenset[str]) -> None:
        self._pou, self._chart = pou, chart
        self._variables = shared | {v.name.lower() for block in pou.blocks for v in block.variables}
        """The variables of the POU and the global ones, in lower case."""
        self._actions = {action.name.lower() for action in pou.actions}
        self._started = f"0chart_{name}" if name else "0chart"
        self._controls: dict[str, list[tuple[t.Step, t.Association]]] = {}
        """By action in lower case: its associations, in the order of the source."""
        for step in chart.steps:
            for one in step.associations:
                self._controls.setdefault(one.action.lower(), []).append((step, one))

    def variables(self) -> list[t.VarDecl]:
        """Return the variables that the statements of the chart use, and that the source does not declare."""
        at = self._pou.pos
        named = {one.name.lower(): one for one in self._chart.transitions if one.body}
        return [
            *(_declared(step.pos, step.name, STEP) for step in self._chart.steps),
            *(_declared(at, control_of(name), "0action_control") for name in self._controls),
            *(_declared(one.pos, one.name, "BOOL") for one in named.values()),
            _declared(at, self._started, "0chart"),
        ]

    # -- statements -------------------------------------------------------------------------------------------------------

    def body(self) -> tuple[t.Statement, ...]:
        """Return the statements that execute the chart once."""
        at = self._pou.pos
        statements: list[t.Statement] = [
            _assign(step.pos, step.name, flag, _false(step.pos))
            for step in self._chart.steps
            for flag in ("0lost", "0gained")
        ]
        statements += self._times()
        statements += self._chart.before
        transitions = sorted(
            self._chart.transitions,
            key=lambda one: (one.priority is None, one.priority if one.priority is not None else 0),
        )
        evolution = tuple(self._evolution(one) for one in transitions)
        first = next(step for step in self._chart.steps if step.initial)
        start = (_assign(at, first.name, "0gained", _true(at)), _assign(at, self._started, "0started", _true(at)))
        statements.append(t.If(at, ((_member(at, self._started, "0started"), evolution),), start))
        statements += [_call(step.pos, step.name) for step in self._chart.steps]
        for name in self._controls:
            statements += self._control(name)
        statements += [self._execution(name) for name in self._controls]
        statements += self._indicators()
        return tuple(statements)

    def _times(self) -> list[t.Statement]:
        """Return statements that set the T of each step, on which a condition may depend, to the present time."""
        conditions = (self._chart.before, tuple((one.condition, one.body) for one in self._chart.transitions))
        used = {node.name.lower() for node in nodes(conditions) if isinstance(node, t.Ref) and _reads_time(node)}
        statements: list[t.Statement] = []
        for step in self._chart.steps:
            if step.name.lower() in used:
                statements += [
                    _assign(step.pos, step.name, "0time_only", _true(step.pos)),
                    _call(step.pos, step.name),
                    _assign(step.pos, step.name, "0time_only", _false(step.pos)),
                ]
        return statements

    def _evolution(self, transition: t.Transition) -> t.Statement:
        """Return the clearing of a transition. An alternative branch of higher priority has already taken the steps."""
        pos = transition.pos
        enabled: list[t.Expr] = [
            t.Binary(pos, "AND", _member(pos, name, "X"), t.Unary(pos, "NOT", _member(pos, name, "0lost")))
            for name in transition.sources
        ]
        cleared = [_assign(pos, name, "0lost", _true(pos)) for name in transition.sources]
        cleared += [_assign(pos, name, "0gained", _true(pos)) for name in transition.targets]
        recorded = (transition.probe,) if transition.probe is not None else ()
        evaluated: list[t.Statement] = [t.If(pos, ((transition.condition, (*recorded, *cleared)),))]
        if transition.body:  # a body that assigns nothing in this scan does not clear the transition
            evaluated[:0] = (t.Assign(pos, t.Ref(pos, transition.name), _false(pos)), *transition.body)
        return t.If(pos, ((_all(pos, "AND", enabled), tuple(evaluated)),))

    def _control(self, name: str) -> list[t.Statement]:
        """Return the statements that set the inputs of an action's control and call it."""
        control, associations = control_of(name), self._controls[name]
        pos = associations[0][1].pos
        statements: list[t.Statement] = []
        for qualifier in dict.fromkeys(one.qualifier for _, one in associations):
            flag = {"P": "0rise", "P1": "0rise", "P0": "0fall"}.get(qualifier, "X")
            steps = [(step, one) for step, one in associations if one.qualifier == qualifier]
            active: list[t.Expr] = [_member(one.pos, step.name, flag) for step, one in steps]
            statements.append(_assign(pos, control, f"0{qualifier.lower()}", _all(pos, "OR", active)))
            for step, one in steps:
                if qualifier in TIMED:
                    time = _assign(one.pos, control, f"0t_{qualifier.lower()}", one.arguments[0])
                    statements.append(t.If(one.pos, ((_member(one.pos, step.name, "X"), (time,)),)))
        return [*statements, _call(pos, control)]

    def _indicators(self) -> list[t.Statement]:
        """Return statements that only make the compiler check the indicator variables: an indicator has no effect (6.7.4.3)."""
        return [
            t.Hold(one.pos, f"0indicator{number}", indicator, f"the indicator of action {one.action}")
            for step in self._chart.steps
            for one in step.associations
            for number, indicator in enumerate(indicators(one))
        ]

    def _execution(self, name: str) -> t.Statement:
        """Return the call of an action while the output of its control is TRUE, or the assignment of the BOOL variable."""
        one = self._controls[name][0][1]
        if name in self._actions or name not in self._variables:
            run = _member(one.pos, control_of(name), "0a")
            return t.If(one.pos, ((run, (_call(one.pos, one.action),)),))
        return t.Assign(one.pos, t.Ref(one.pos, one.action), _member(one.pos, control_of(name), "0q"))


def control_of(name: str) -> str:
    """Return the name of the block that controls an action."""
    return f"0control_{name}"


def _reads_time(ref: t.Ref) -> bool:
    """Return whether a reference may be the T of a step."""
    first = ref.selectors[0] if ref.selectors else None
    return isinstance(first, t.Member) and first.name.lower() == "t"


def _declared(pos: t.Pos, name: str, kind: str) -> t.VarDecl:
    return t.VarDecl(pos, name, t.NamedType(pos, kind), None)


def _true(pos: t.Pos) -> t.Expr:
    return t.Literal(pos, "TRUE", "TRUE")


def _false(pos: t.Pos) -> t.Expr:
    return t.Literal(pos, "FALSE", "FALSE")


def _member(pos: t.Pos, name: str, *members: str) -> t.Ref:
    return t.Ref(pos, name, tuple(t.Member(pos, member) for member in members))


def _assign(pos: t.Pos, name: str, member: str, value: t.Expr) -> t.Assign:
    return t.Assign(pos, _member(pos, name, member), value)


def _call(pos: t.Pos, name: str) -> t.CallStatement:
    return t.CallStatement(pos, t.Call(pos, t.Ref(pos, name)))


def _all(pos: t.Pos, operator: str, parts: list[t.Expr]) -> t.Expr:
    """Return the parts joined by AND or OR."""
    first, *rest = parts
    for part in rest:
        first = t.Binary(pos, operator, first, part)
    return first


@cache
def _blocks() -> tuple[t.Pou, ...]:
    """Return the function blocks of steps and actions, with names that no source can contain."""
    return tuple(_renamed(pou) for pou in parse(_BLOCKS).pous)


def _renamed(node: Any) -> Any:
    if isinstance(node, str):
        return f"0{node.removeprefix(_HIDDEN)}" if node.startswith(_HIDDEN) else node
    return with_parts(node, _renamed)
