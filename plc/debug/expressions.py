"""Expressions in Structured Text that a user writes while a program runs: watches, conditions, messages, new values.

They are compiled by the compiler of the program, in the scope of one POU, so that the types are checked. An expression that
could change a variable is refused, because a watch must not change what it shows.
"""

from __future__ import annotations

from collections.abc import Container, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from types import CodeType
from typing import Any

from fieldtwin.gateway.core.errors import FieldtwinError, FileInvalid, UsageError
from fieldtwin.gateway.core.files.error_collector import ErrorCollector
from fieldtwin.plc.st import types as ty
from fieldtwin.plc.st.classes.instance_variables import beginning
from fieldtwin.plc.st.compiler.calls import Calls
from fieldtwin.plc.st.compiler.classes.members import method_of
from fieldtwin.plc.st.compiler.compile import CompiledUnit
from fieldtwin.plc.st.compiler.functions.standard import FUNCTIONS
from fieldtwin.plc.st.compiler.scope import CodeWriter, Symbol
from fieldtwin.plc.st.context import MAX_STEPS
from fieldtwin.plc.st.dialects import WarningCollector
from fieldtwin.plc.st.syntax import tree as t
from fieldtwin.plc.st.syntax.parse import parse_expression
from fieldtwin.plc.st.syntax.walk import nodes

MAX_TEXT = 1000
"""The longest expression, in characters."""
_AT = t.Pos(1, 1, element="expression")
_FAILURES = (
    FieldtwinError,
    ArithmeticError,
    AttributeError,
    LookupError,
    NameError,
    RecursionError,
    TypeError,
    ValueError,
)
"""The exceptions of an evaluation. A local variable of a function raises one before its initial value is assigned."""


@dataclass(frozen=True, slots=True)
class Expression:
    """A compiled expression, its text and its type."""

    text: str
    type: ty.Type
    code: CodeType

    def value(self, space: Mapping[str, Any], local: Mapping[str, Any]) -> Any:
        """Return the value, with the global names `space` of the compiled unit and the `local` names of the POU that executes.

        Raises `UsageError` if the evaluation fails, such as by a division by zero. It uses up no steps of the scan.
        """
        names = {**space, **local}
        context = names["_c"]
        left, context.left = context.left, MAX_STEPS
        try:
            exec(self.code, names)  # the compiler of Structured Text wrote the code
        except _FAILURES as e:
            message = e.message if isinstance(e, FieldtwinError) else str(e)
            raise UsageError(f"{self.text} has no value here: {message}") from e
        finally:
            context.left = left
        return names["_result"]


def compile_expression(unit: CompiledUnit, pou: str, text: str, wanted: ty.Type | None = None) -> Expression:
    """Compile an expression in the scope of a POU, or of a method (``pou.method``), by its name in lower case.

    With `wanted` the value is converted to this type, as in an assignment. Raises `UsageError` for an expression that is not
    valid there, and for one that could change a variable.
    """
    if len(text) > MAX_TEXT:
        raise UsageError("an expression that is too long", expected=f"at most {MAX_TEXT} characters")
    if unit.environment is None:
        hint = "restart the PLC, or name a variable"
        raise UsageError("expressions cannot be compiled after an online change", hint=hint)
    env = replace(
        unit.environment,
        faulty=set(),
        faulty_here=set(),
        errors=ErrorCollector(),
        warnings=WarningCollector(),
        recorded={},
        probed={},
        calls={},
        inner={block: {name.lower(): (name, kind) for name, kind in of} for block, of in unit.blocks.items()},
    )
    symbols = visible(env.symbols, pou)
    out = CodeWriter()
    compiler = Calls(env, symbols, out, pou)
    compiler.own = env.classes.get(known_part(pou, env.classes))
    compiler.program_inputs = {s.name for s in symbols.values() if s.is_input} if _is_program(unit, pou) else set()
    try:
        tree = parse_expression(text, _AT)
        _refuse_changes(unit, compiler, tree)
        value = compiler.value(tree, wanted)
        if wanted is None:
            value = compiler.typed(value, _AT)
        code, kind = (compiler.coerced(value, wanted, _AT), wanted) if wanted is not None else (value.code, value.type)
    except FileInvalid as e:
        message = e.message.removeprefix("expression: ").removeprefix(f"{text.strip()}: ")
        raise UsageError(f"{text.strip()}: {message}", expected=e.expected, got=e.got, hint=e.hint) from e
    lines = [line for line, _ in out.lines]
    return Expression(text.strip(), kind, compile("\n".join([*lines, f"_result = {code}"]), "<expression>", "exec"))


def visible(symbols: Mapping[str, Mapping[str, Symbol]], pou: str) -> dict[str, Symbol]:
    """Return the variables that a POU or method sees; an action sees those of its POU."""
    found = dict(symbols.get(known_part(pou, symbols), {}))
    return {**found, **{one.name: one for one in instance_variables(pou, found.values())}}


def instance_variables(pou: str, symbols: Iterable[Symbol]) -> list[Symbol]:
    """Return the VAR_INST of a method (``pou.method``) with their own names; they belong to its owner under other names."""
    method, accessor = pou, "method"
    if pou.rpartition(".")[2] in ("get", "set"):
        method, _, accessor = pou.rpartition(".")
    before = beginning(accessor, method.rpartition(".")[2]).lower()
    return [replace(one, name=one.name[len(before) :]) for one in symbols if one.name.lower().startswith(before)]


def known_part(key: str, known: Container[str]) -> str:
    """Return the longest part of a key ``namespace.pou.method`` from its beginning that is in `known`; "" for none."""
    while key and key not in known:
        key = key.rpartition(".")[0]
    return key


def _is_program(unit: CompiledUnit, pou: str) -> bool:
    return bool(known_part(pou, {program.name.lower() for program in unit.programs}))


def _refuse_changes(unit: CompiledUnit, compiler: Calls, tree: t.Expr) -> None:
    """Raise `UsageError` if an expression calls a method, or a function that could change a variable outside of it."""
    functions = {pou.name.lower(): pou for pou in unit.source.pous if pou.kind == "FUNCTION"}
    for call in (node for node in nodes(tree) if isinstance(node, t.Call)):
        name = call.ref.name
        if any(argument.target is not None for argument in call.arguments):
            raise UsageError(f"{name} in an expression of the debugger", expected="no output argument")
        if method_of(compiler, call.ref, "METHOD") is not None:
            raise UsageError(
                "a method in an expression of the debugger", expected="functions that change no variable", got=name
            )
        if _changes(name.lower(), functions, set()):
            raise UsageError(f"the function {name} in an expression of the debugger may change variables")


def _changes(name: str, functions: Mapping[str, t.Pou], seen: set[str]) -> bool:
    """Return whether a user's function assigns a variable that is not its own, calls a method, or has a VAR_IN_OUT."""
    pou = functions.get(name)
    if pou is None or name in seen:
        return False
    seen.add(name)
    if any(block.kind == "VAR_IN_OUT" for block in pou.blocks):
        return True
    own = {v.name.lower() for block in pou.blocks if block.kind != "VAR_EXTERNAL" for v in block.variables} | {name}
    if any(ref.name.lower() not in own or _is_dereferenced(ref) for ref in _assigned(pou)):
        return True
    for call in (node for node in nodes(pou.body) if isinstance(node, t.Call)):
        called = call.ref.name.lower()
        known = called in own or called in functions or FUNCTIONS.find(called.upper()) is not None
        if call.ref.selectors or not known or _changes(called, functions, seen):
            return True
    return False


def _assigned(pou: t.Pou) -> Iterator[t.Ref]:
    """Yield the variables that a body assigns, also as the control variable of a loop or by an output argument."""
    for node in nodes(pou.body):
        target = getattr(node, "target", None) or getattr(node, "variable", None)
        if isinstance(target, t.Ref):
            yield target


def _is_dereferenced(ref: t.Ref) -> bool:
    return any(isinstance(selector, t.Deref) for selector in ref.selectors)
