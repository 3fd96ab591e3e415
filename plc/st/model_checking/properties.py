"""Questions about a program: invariants, the states of its state machines, and assumptions about its inputs.

Each is an expression in Structured Text. It becomes an action of its POU, which assigns it to a variable that is not in the
source. So the compiler checks the expression, and the compiled program evaluates it, in a proof and in a replay alike.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

from fieldtwin.gateway.core.errors import FileInvalid, UsageError
from fieldtwin.plc.st.classes.readable import readable
from fieldtwin.plc.st.compiler.compile import CompiledUnit, compile_unit
from fieldtwin.plc.st.dialects import Dialect
from fieldtwin.plc.st.model_checking.transition import HIDDEN, action_of
from fieldtwin.plc.st.state_diagram import OTHER, StateDiagram, state_diagrams
from fieldtwin.plc.st.syntax import tree as t
from fieldtwin.plc.st.syntax.parse import parse_expression

MAX_STATES = 200
"""A state machine with more states is left out."""
_RANGE = re.compile(r"(-?\w+)\.\.(-?\w+)")


@dataclass(frozen=True, slots=True)
class Expression:
    """An expression in Structured Text over the variables of a POU: its text, and a name by which messages refer to it."""

    name: str
    text: str
    pou: str
    key: str
    """The name of the variable that holds its result."""


@dataclass(frozen=True, slots=True)
class State:
    """A state of a state machine. `away` is true while no instance of the POU is in the state."""

    machine: StateDiagram
    state: str
    away: Expression


@dataclass(frozen=True, slots=True)
class Asked:
    """A unit with actions for all that is asked."""

    unit: CompiledUnit
    invariants: tuple[Expression, ...]
    assumptions: tuple[Expression, ...]
    states: tuple[State, ...]


def named(text: str) -> tuple[str, str]:
    """Return name and expression of ``NAME: EXPRESSION``, or of an expression alone, whose name is its text."""
    found = re.fullmatch(r"\s*([^:()'\"]+?)\s*:(?!=)\s*(.+)", text, re.DOTALL)
    return (found.group(1), found.group(2).strip()) if found else (text.strip(), text.strip())


def asked(
    unit: t.SourceUnit, program: str, path: str, dialect: Dialect,
    invariants: Sequence[tuple[str, str]], assumptions: Sequence[tuple[str, str]],
) -> Asked:  # fmt: skip
    """Compile the declarations `unit` of the file or folder `path` with actions for what is asked about `program`.

    `invariants` and `assumptions` are names with expressions. Raises `FileInvalid` for an error in the unit, and `UsageError`
    for an error in an expression.
    """
    files = tuple(dict.fromkeys(d.pos.path for d in (*unit.types, *unit.globals, *unit.pous)))
    compile_unit(unit, path, files, dialect)  # an error of the program is not one of an expression
    numbers = iter(range(10**9))

    def expressions(given: Sequence[tuple[str, str]]) -> tuple[Expression, ...]:
        return tuple(Expression(name, text, program, f"{HIDDEN}{next(numbers)}") for name, text in given)

    own, supposed = expressions(invariants), expressions(assumptions)
    states = tuple(
        State(machine, state, Expression(f"{machine.pou}.{state}", text, machine.pou, f"{HIDDEN}{next(numbers)}"))
        for machine in state_diagrams(unit)
        if len(machine.states) <= MAX_STATES and not _is_reference(unit, machine)
        for state, text in _states(unit, machine)
    )
    whole = replace(unit, pous=tuple(map(readable, unit.pous)))
    for each in (*own, *supposed):
        whole = _with_action(whole, each)
        try:
            compile_unit(whole, path, files, dialect)
        except FileInvalid as e:
            raise UsageError(f"{each.name}: {e.message}", expected=e.expected, got=e.got, hint=e.hint) from e
    for state in states:
        whole = _with_action(whole, state.away)
    return Asked(compile_unit(whole, path, files, dialect), own, supposed, states)


def _with_action(unit: t.SourceUnit, expression: Expression) -> t.SourceUnit:
    """Return `unit` with the action and the variable of `expression` in its POU."""
    try:
        tree = parse_expression(expression.text, t.Pos(1, 1))
    except FileInvalid as e:
        raise UsageError(
            f"{expression.name}: {e.message}", expected=e.expected or "an expression in Structured Text", got=e.got
        ) from e
    pous = tuple(
        _extended(pou, expression, tree) if pou.name.lower() == expression.pou.lower() else pou for pou in unit.pous
    )
    return replace(unit, pous=pous)


def _extended(pou: t.Pou, expression: Expression, tree: t.Expr) -> t.Pou:
    pos = replace(pou.pos, element=f"the expression {expression.name!r}")
    variable = t.VarDecl(pos, expression.key, t.NamedType(pos, "BOOL"), None)
    block = t.VarBlock(pos, "VAR", frozenset(), (variable,))
    action = t.Action(pos, action_of(expression.key), (t.Assign(pos, t.Ref(pos, expression.key), tree),))
    return replace(pou, blocks=(*pou.blocks, block), actions=(*pou.actions, action))


# -- states ---------------------------------------------------------------------------------------------------------------


def _states(unit: t.SourceUnit, machine: StateDiagram) -> Iterator[tuple[str, str]]:
    """Return each state of a machine with the expression that is true while the machine is not in it."""
    enum = _enumeration(unit, machine)
    for state in machine.states:
        if state == OTHER:
            continue
        if not machine.variable:
            yield state, f"NOT {state}.X"
        elif enum:
            yield state, f"{machine.variable} <> {enum}#{state}"
        elif found := _RANGE.fullmatch(state):
            yield state, f"({machine.variable} < {found.group(1)}) OR ({machine.variable} > {found.group(2)})"
        else:
            yield state, f"{machine.variable} <> {state}"


def _declared(unit: t.SourceUnit, machine: StateDiagram) -> tuple[t.VarDecl, str] | None:
    """Return the declaration of the variable of a machine, and the kind of its block."""
    blocks = [block for pou in unit.pous if pou.name == machine.pou for block in pou.blocks]
    for block in (*blocks, *unit.globals):
        for variable in block.variables:
            if variable.name.lower() == machine.variable.lower():
                return variable, block.kind
    return None


def _is_reference(unit: t.SourceUnit, machine: StateDiagram) -> bool:
    """Return whether the state is kept outside of the POU, so that an instance alone has none."""
    found = _declared(unit, machine)
    return found is not None and found[1] == "VAR_IN_OUT"


def _enumeration(unit: t.SourceUnit, machine: StateDiagram) -> str:
    """Return the name of the enumeration that is the type of a machine's variable; "" for a number."""
    found = _declared(unit, machine)
    if found is None or not isinstance(found[0].type, t.NamedType):
        return ""
    name = found[0].type.name
    return next((e.name for e in unit.types if isinstance(e, t.EnumDecl) and e.name.lower() == name.lower()), "")
