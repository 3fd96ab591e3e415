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
from fieldtwin.gateway.core.files.nearest import did_you_mean
from fieldtwin.plc.st.charts.reachability import check_reachability
from fieldtwin.plc.st.syntax import tree as t
from fieldtwin.plc.st.syntax.errors import invalid
from fieldtwin.plc.st.syntax.parse import parse
from fieldtwin.plc.st.syntax.walk import nodes, with_parts

_TIMED = ("L", "D", "SD", "DS", "SL")
_QUALIFIERS = ("N", "R", "S", "P", "P0", "P1", *_TIMED)
_HIDDEN = "hidden_"
STEP = "0step"
"""The name of the function block of a step."""
_BLOCKS = """
FUNCTION_BLOCK hidden_chart VAR_INPUT hidden_started : BOOL; END_VAR END_FUNCTION_BLOCK
FUNCTION_BLOCK hidden_step
VAR_INPUT hidden_lost, hidden_gained : BOOL; END_VAR
VAR_OUTPUT X : BOOL; T : TIME; hidden_rise, hidden_fall : BOOL; END_VAR
VAR hidden_now : BOOL; hidden_timer : TON; END_VAR
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
    """Return `unit` with the charts of its POUs as statements.

    Raises `FileInvalid` with line and column for the first error of a chart, and with the others.
    """
    if all(pou.chart is None for pou in unit.pous):
        return unit
    found = ErrorCollector()
    shared = frozenset(v.name.lower() for block in unit.globals for v in block.variables)
    pous = tuple(
        _Translation(pou, pou.chart, shared, found).pou() if pou.chart is not None else pou for pou in unit.pous
    )
    found.raise_all()
    return replace(unit, pous=(*_blocks(), *pous))


class _Translation:
    """The translation of the chart of one POU."""

    def __init__(self, pou: t.Pou, chart: t.Chart, shared: frozenset[str], found: ErrorCollector) -> None:
        self._pou, self._chart, self._found = pou, chart, found
        self._variables = shared | {v.name.lower() for block in pou.blocks for v in block.variables}
        """The variables of the POU and the global ones, in lower case."""
        self._steps = {step.name.lower(): step for step in chart.steps}
        self._actions = {action.name.lower() for action in pou.actions}
        self._controls: dict[str, list[tuple[t.Step, t.Association]]] = {}
        """By action in lower case: its associations, in the order of the source."""

    def pou(self) -> t.Pou:
        before = len(self._found.errors)
        self._check()
        if len(self._found.errors) > before:
            return replace(self._pou, chart=None)
        for step in self._chart.steps:
            for one in step.associations:
                self._controls.setdefault(one.action.lower(), []).append((step, one))
        at = self._pou.pos
        variables = [_declared(step.pos, step.name, STEP) for step in self._chart.steps]
        variables += [_declared(at, _control(name), "0action_control") for name in self._controls]
        variables.append(_declared(at, "0chart", "0chart"))
        block = t.VarBlock(at, "VAR", frozenset(), tuple(variables))
        return replace(self._pou, blocks=(*self._pou.blocks, block), body=self._body(), chart=None)

    # -- checks -----------------------------------------------------------------------------------------------------------

    def _check(self) -> None:
        if self._pou.body:
            self._bad(self._pou.body[0].pos, "a statement next to steps", hint="put it into an ACTION")
        seen: set[str] = set()
        for step in self._chart.steps:
            if step.name.lower() in seen:
                self._bad(step.pos, f"step {step.name} is declared twice")
            seen.add(step.name.lower())
            for one in step.associations:
                self._check_association(one)
            self._check_twice(step)
        self._check_calls()
        initial = [step for step in self._chart.steps if step.initial]
        if not initial:
            pos = (self._chart.steps or self._chart.transitions)[0].pos
            self._bad(pos, f"the chart of {self._pou.name} has no initial step", expected="one INITIAL_STEP")
        for step in initial[1:]:
            message = f"{step.name} is a second initial step; the first is {initial[0].name}"
            self._bad(step.pos, message, expected="one INITIAL_STEP")
        known = [step.name for step in self._chart.steps]
        complete = len(initial) == 1 and len(seen) == len(known)
        for transition in self._chart.transitions:
            for name in (*transition.sources, *transition.targets):
                if name.lower() not in seen:
                    complete = False
                    self._bad(transition.pos, f"step {name!r} is not declared", hint=did_you_mean(name, known))
        if complete:
            for error in check_reachability(self._chart):
                self._found.add(error)

    def _check_twice(self, step: t.Step) -> None:
        seen: set[tuple[str, str]] = set()
        for one in step.associations:
            if (one.action.lower(), one.qualifier) in seen:
                self._bad(one.pos, f"step {step.name} has action {one.action} twice with the qualifier {one.qualifier}")
            seen.add((one.action.lower(), one.qualifier))

    def _check_calls(self) -> None:
        """Refuse the call of a step by an action. The chart itself calls the blocks of its steps."""
        for one in nodes(self._pou.actions):
            if isinstance(one, t.Call) and one.ref.name.lower() in self._steps:
                self._bad(one.pos, f"step {one.ref.name} cannot be called", hint="a transition activates a step")

    def _check_association(self, one: t.Association) -> None:
        if one.qualifier not in _QUALIFIERS:
            self._bad(one.pos, f"the qualifier of action {one.action}", ", ".join(_QUALIFIERS), one.qualifier)
        elif one.qualifier in _TIMED and not one.arguments:
            self._bad(one.pos, f"action {one.action} has no time", f"{one.action}({one.qualifier}, T#1s)")
        elif len(one.arguments) > (one.qualifier in _TIMED):
            self._bad(one.pos, f"indicator variables are not supported, and action {one.action} has one")

    def _bad(self, pos: t.Pos, message: str, expected: str = "", got: str = "", hint: str = "") -> None:
        self._found.add(invalid(pos, message, expected, got, hint))

    # -- statements -------------------------------------------------------------------------------------------------------

    def _body(self) -> tuple[t.Statement, ...]:
        at = self._pou.pos
        statements: list[t.Statement] = [
            _assign(step.pos, step.name, flag, _false(step.pos))
            for step in self._chart.steps
            for flag in ("0lost", "0gained")
        ]
        statements += self._chart.before
        transitions = sorted(
            self._chart.transitions,
            key=lambda one: (one.priority is None, one.priority if one.priority is not None else 0),
        )
        evolution = tuple(self._evolution(one) for one in transitions)
        first = next(step for step in self._chart.steps if step.initial)
        start = (_assign(at, first.name, "0gained", _true(at)), _assign(at, "0chart", "0started", _true(at)))
        statements.append(t.If(at, ((_member(at, "0chart", "0started"), evolution),), start))
        statements += [_call(step.pos, step.name) for step in self._chart.steps]
        for name in self._controls:
            statements += self._control(name)
        statements += [self._execution(name) for name in self._controls]
        return tuple(statements)

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
        inner = t.If(pos, ((transition.condition, (*recorded, *cleared)),))
        return t.If(pos, ((_all(pos, "AND", enabled), (inner,)),))

    def _control(self, name: str) -> list[t.Statement]:
        """Return the statements that set the inputs of an action's control and call it."""
        control, associations = _control(name), self._controls[name]
        pos = associations[0][1].pos
        statements: list[t.Statement] = []
        for qualifier in dict.fromkeys(one.qualifier for _, one in associations):
            flag = {"P": "0rise", "P1": "0rise", "P0": "0fall"}.get(qualifier, "X")
            steps = [(step, one) for step, one in associations if one.qualifier == qualifier]
            active: list[t.Expr] = [_member(one.pos, step.name, flag) for step, one in steps]
            statements.append(_assign(pos, control, f"0{qualifier.lower()}", _all(pos, "OR", active)))
            for step, one in steps:
                if one.arguments:
                    time = _assign(one.pos, control, f"0t_{qualifier.lower()}", one.arguments[0])
                    statements.append(t.If(one.pos, ((_member(one.pos, step.name, "X"), (time,)),)))
        return [*statements, _call(pos, control)]

    def _execution(self, name: str) -> t.Statement:
        """Return the call of an action while the output of its control is TRUE, or the assignment of the BOOL variable."""
        one = self._controls[name][0][1]
        if name in self._actions or name not in self._variables:
            run = _member(one.pos, _control(name), "0a")
            return t.If(one.pos, ((run, (_call(one.pos, one.action),)),))
        return t.Assign(one.pos, t.Ref(one.pos, one.action), _member(one.pos, _control(name), "0q"))


def _control(name: str) -> str:
    return f"0control_{name}"


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
