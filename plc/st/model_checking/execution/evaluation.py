"""Evaluates expressions of compiled Python code on symbolic values."""

from __future__ import annotations

import ast
import builtins
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from types import MethodType
from typing import Any

import z3

from fieldtwin.plc.st import values
from fieldtwin.plc.st.model_checking.execution import floats, operations
from fieldtwin.plc.st.model_checking.execution.mailboxes import Outgoing
from fieldtwin.plc.st.model_checking.execution.memory import Memory
from fieldtwin.plc.st.model_checking.execution.merging import merged, options_of
from fieldtwin.plc.st.model_checking.execution.natives import BUILTINS, OF_VALUES
from fieldtwin.plc.st.model_checking.execution.operations import is_known, is_text, is_unknown_text, truth
from fieldtwin.plc.st.model_checking.execution.refusal import NotModelled
from fieldtwin.plc.st.model_checking.execution.sources import Sources
from fieldtwin.plc.st.model_checking.execution.symbolic import (
    TEXT,
    UNDEFINED,
    Choice,
    Condition,
    Int,
    Text,
    Undefined,
    both,
    either,
    made,
    negated,
    width,
)
from fieldtwin.plc.st.runtime import copying, layouts, moments
from fieldtwin.plc.st.runtime.references import Element, MemberReference

_OPERATORS: dict[type, str] = {
    ast.Add: "+", ast.Sub: "-", ast.Pow: "**", ast.Mult: "*", ast.Div: "/", ast.FloorDiv: "//", ast.Mod: "%", ast.BitAnd: "&",
    ast.BitOr: "|", ast.BitXor: "^", ast.LShift: "<<", ast.RShift: ">>", ast.Eq: "==", ast.NotEq: "!=", ast.Lt: "<",
    ast.LtE: "<=", ast.Gt: ">", ast.GtE: ">=", ast.Not: "not", ast.USub: "-", ast.Invert: "~",
}  # fmt: skip


@dataclass(slots=True)
class Frame:
    """A call: its local variables, and the namespace of its function. `own`: the function belongs to the unit."""

    space: Mapping[str, Any]
    own: bool
    local: dict[str, Any] = field(default_factory=dict)
    loops: list[int] = field(default_factory=list)
    """The numbers of the loops around the statement."""


@dataclass(frozen=True, slots=True)
class Closure:
    """A lambda, with the call in which it was evaluated."""

    body: ast.expr
    frame: Frame


@dataclass(frozen=True, slots=True)
class Encoding:
    """The method that returns the bytes of a text that is not known."""

    text: Text


@dataclass(frozen=True, slots=True)
class Failure:
    """An error that ends a scan, such as a division by zero: the condition under which it occurs."""

    condition: Condition
    message: str
    line: int


class Evaluation:
    """The evaluation of expressions. `call` of a subclass executes a function.

    `failures` are the errors that can end the scan. `unknowns` are the results that have no model: an expression of Z3 that may
    have any value, and what it stands for.
    """

    def __init__(self, sources: Sources, memory: Memory) -> None:
        self.sources, self.memory = sources, memory
        self.failures: list[Failure] = []
        self.unknowns: list[tuple[Any, str, int]] = []
        self.line = 0
        """The line of the unit's Python code that is being executed."""

    def run(self, function: Callable[..., Any], given: tuple[Any, ...]) -> Any:
        raise NotImplementedError

    def fail_if(self, condition: Condition, message: str) -> None:
        found = both(self.memory.path, condition)
        if found is not False:
            self.failures.append(Failure(found, message, self.line))

    def unknown(self, what: str) -> floats.Float:
        """Return a number that may have any value, as the result of `what`."""
        return floats.Float(self._unknown(what, z3.Float64()))

    def unknown_condition(self, what: str) -> Condition:
        """Return a condition that may be true or false, as the result of `what`."""
        return self._unknown(what, z3.BoolSort())

    def unknown_integer(self, what: str, low: int, high: int) -> Int | int:
        """Return an integer that may have any value from `low` to `high`, as the result of `what`."""
        found = self._unknown(what, z3.BitVecSort(width(low, high)))
        return made(z3.If(z3.And(found >= low, found <= high), found, low), low, high)

    def _unknown(self, what: str, sort: Any) -> Any:
        found = z3.Const(f"unknown{len(self.unknowns)}", sort)
        self.unknowns.append((found, what, self.line))
        return found

    # -- attributes -------------------------------------------------------------------------------------------------------

    def attribute(self, owner: Any, name: str) -> Any:
        if isinstance(owner, Choice):
            result: Any = UNDEFINED
            for condition, option in owner.options:
                result = merged(condition, self.attribute(option, name), result)
            return result
        if isinstance(owner, Undefined) or owner is None:
            return UNDEFINED
        if isinstance(owner, Text):
            if name == "encode":
                return Encoding(owner)
            raise NotModelled(operations.STRINGS)
        if isinstance(owner, Outgoing) and name == "room":
            return owner.room_left(self)
        if isinstance(owner, Element) and name == "v" and isinstance(owner.owner, list):
            self._check_element(owner)
            return operations.item(owner.owner, owner.at)
        found = getattr(type(owner), name, None)
        return self.run(found.fget, (owner,)) if isinstance(found, property) and found.fget else getattr(owner, name)

    def put_attribute(self, owner: Any, name: str, value: Any) -> None:
        if isinstance(owner, Choice):
            for condition, option in owner.options:
                self.memory.open(condition)
                self.put_attribute(option, name, value)
                self.memory.close()
            return
        if isinstance(owner, Undefined) or owner is None:
            return
        if isinstance(owner, MemberReference) and name == "v":  # without the line, on which no scan depends
            self.put_attribute(owner.owner, owner.name, value)
            return
        if isinstance(owner, Element) and name == "v" and isinstance(owner.owner, list):
            self._check_element(owner)
            self.put_item(owner.owner, owner.at, value)
            return
        found = getattr(type(owner), name, None)
        if isinstance(found, property):
            assert found.fset is not None
            self.run(found.fset, (owner, value))
        else:
            self.memory.put(owner, name, value)

    def _check_element(self, reference: Element) -> None:
        """Note that a reference fails outside of its array."""
        at, count = reference.at, len(reference.owner)
        outside = either(operations.compare("<", at, 0), operations.compare(">=", at, count))
        self.fail_if(outside, "a pointer outside the variable to which it pointed")

    def put_item(self, items: list[Any], index: Any, value: Any) -> None:
        """Assign an element of a list, whose index may be symbolic. An index outside of the list is excluded before."""
        if isinstance(index, int):
            if 0 <= index < len(items):
                self.memory.put(items, index, value)
        elif isinstance(index, Int):
            for n in range(max(0, index.low), min(len(items) - 1, index.high) + 1):
                self.memory.put(items, n, merged(operations.compare("==", index, n), value, items[n]))

    # -- expressions ------------------------------------------------------------------------------------------------------

    def value(self, node: ast.expr, frame: Frame) -> Any:
        """Return the value of an expression. Raises `NotModelled`."""
        if frame.own:
            self.line = getattr(node, "lineno", self.line)
        return getattr(self, f"_{type(node).__name__.lower()}", self._other)(node, frame)

    def _other(self, node: ast.expr, frame: Frame) -> Any:
        raise NotModelled(f"an expression of the kind {type(node).__name__}")

    def _constant(self, node: ast.Constant, frame: Frame) -> Any:
        return node.value

    def _name(self, node: ast.Name, frame: Frame) -> Any:
        if node.id in frame.local:
            return frame.local[node.id]
        if node.id in frame.space:
            return frame.space[node.id]
        return getattr(builtins, node.id, UNDEFINED)

    def _attribute(self, node: ast.Attribute, frame: Frame) -> Any:
        return self.attribute(self.value(node.value, frame), node.attr)

    def _tuple(self, node: ast.Tuple, frame: Frame) -> Any:
        return tuple([self.value(each, frame) for each in node.elts])

    def _list(self, node: ast.List, frame: Frame) -> Any:
        return [self.value(each, frame) for each in node.elts]

    def _listcomp(self, node: ast.ListComp | ast.GeneratorExp, frame: Frame) -> Any:
        (part,) = node.generators
        assert isinstance(part.target, ast.Name)
        inner = Frame(frame.space, frame.own, dict(frame.local))
        found = []
        for each in self.value(part.iter, frame):
            inner.local[part.target.id] = each
            found.append(self.value(node.elt, inner))
        return found

    _generatorexp = _listcomp

    def _lambda(self, node: ast.Lambda, frame: Frame) -> Any:
        return Closure(node.body, frame)

    def _namedexpr(self, node: ast.NamedExpr, frame: Frame) -> Any:
        value = self.value(node.value, frame)
        self.memory.put(frame.local, node.target.id, value)
        return value

    def _subscript(self, node: ast.Subscript, frame: Frame) -> Any:
        owner = self.value(node.value, frame)
        if isinstance(node.slice, ast.Slice):
            parts = [self.value(p, frame) if p else None for p in (node.slice.lower, node.slice.upper, node.slice.step)]
            known = all(map(is_known, parts))
            if known and (isinstance(owner, list) or is_known(owner)):
                return owner[slice(*parts)]
            if not is_text(owner):
                raise NotModelled("a part of an array whose limits are not known")
            return TEXT
        index = self.value(node.slice, frame)
        result: Any = UNDEFINED
        for condition, option in options_of(owner):
            if not isinstance(option, list | tuple | str | Text | Undefined):
                raise NotModelled("an element of such a value")
            if isinstance(option, Undefined | Text):
                found: Any = option if isinstance(option, Undefined) else TEXT
            else:
                found = operations.item(list(option), index)
            result = merged(condition, found, result)
        return result

    def _unaryop(self, node: ast.UnaryOp, frame: Frame) -> Any:
        return operations.unary(_OPERATORS[type(node.op)], self.value(node.operand, frame))

    def _binop(self, node: ast.BinOp, frame: Frame) -> Any:
        left = self.value(node.left, frame)
        return operations.binary(_OPERATORS[type(node.op)], left, self.value(node.right, frame))

    def _boolop(self, node: ast.BoolOp, frame: Frame) -> Any:
        """Return the value of AND or OR. A later operand is evaluated on a path, because it may fail or assign a variable."""
        conjunction, opened = isinstance(node.op, ast.And), 0
        parts: list[Any] = []
        for operand in node.values:
            value = self.value(operand, frame)
            parts.append(value)
            goes_on = truth(value) if conjunction else negated(truth(value))
            if goes_on is False:
                break
            self.memory.open(goes_on)
            opened += 1
        for _ in range(opened):
            self.memory.close()
        result = parts.pop()
        while parts:
            value = parts.pop()
            result = merged(truth(value), result, value) if conjunction else merged(truth(value), value, result)
        return result

    def _ifexp(self, node: ast.IfExp, frame: Frame) -> Any:
        condition = truth(self.value(node.test, frame))
        if isinstance(condition, bool):
            return self.value(node.body if condition else node.orelse, frame)
        found = []
        for path, part in ((condition, node.body), (negated(condition), node.orelse)):
            self.memory.open(path)
            found.append(self.value(part, frame))
            self.memory.close()
        return merged(condition, *found)

    def _compare(self, node: ast.Compare, frame: Frame) -> Any:
        left, result = self.value(node.left, frame), True
        for op, part in zip(node.ops, node.comparators, strict=True):
            right = self.value(part, frame)
            result = both(result, self._compared(op, left, right))
            left = right
        return result

    def _compared(self, op: ast.cmpop, left: Any, right: Any) -> Condition:
        if isinstance(op, ast.Is | ast.IsNot):
            found = operations.is_none(left)
            return found if isinstance(op, ast.Is) else negated(found)
        if isinstance(op, ast.In | ast.NotIn):
            found = either(*(operations.compare("==", left, each) for each in right))
            return found if isinstance(op, ast.In) else negated(found)
        if is_unknown_text(left) or is_unknown_text(right):
            return self.unknown_condition("the comparison of a STRING")
        return operations.compare(_OPERATORS[type(op)], left, right)

    # -- calls ------------------------------------------------------------------------------------------------------------

    def _call(self, node: ast.Call, frame: Frame) -> Any:
        function = self.value(node.func, frame)
        given = []
        for argument in node.args:
            if isinstance(argument, ast.Starred):
                given += list(self.value(argument.value, frame))
            else:
                given.append(self.value(argument, frame))
        named = {word.arg: self.value(word.value, frame) for word in node.keywords if word.arg}
        line = self.line
        result = self.called(function, tuple(given), named)
        self.line = line
        return result

    def called(self, function: Any, given: tuple[Any, ...], named: Mapping[str, Any] | None = None) -> Any:
        """Return the result of a call."""
        if isinstance(function, Choice):
            return self._called_choice(function, given)
        if isinstance(function, Closure):
            return self.value(function.body, function.frame)
        if isinstance(function, Undefined):
            return UNDEFINED
        if isinstance(function, Encoding):
            return function.text
        if getattr(function, "modelled", False):
            if isinstance(function, MethodType):
                return function(self, *given)
            return function(given[0], self, *given[1:])
        if isinstance(function, MethodType):
            return self.called(function.__func__, (function.__self__, *given), named)
        name, module = getattr(function, "__name__", ""), getattr(function, "__module__", None)
        if module in (values.__name__, moments.__name__) and not isinstance(function, type):
            return self._of_values(function, name, given, dict(named or {}))
        if isinstance(function, type) and issubclass(function, layouts.Union):
            raise NotModelled("a union")
        if module == layouts.__name__:
            return function(*given)
        if module == copying.__name__:
            raise NotModelled(str(given[0]))
        if isinstance(function, type) and function not in (bool, int, float, range, str, zip):
            return function(*given, **(named or {}))
        if self.sources.is_own(function) or ((module or "").startswith("fieldtwin.") and name != "is_good"):
            return self.run(function, given)
        if name in BUILTINS:
            if all(map(is_known, given)) and name not in ("setattr", "zip"):
                return function(*given)
            return BUILTINS[name](self, given)
        if all(map(is_known, given)) or name in ("__new__", "is_good"):
            return function(*given, **(named or {}))
        what = name.upper() if module == "math" else name
        if module == "math" and all(isinstance(each, floats.Float | Int | int | float) for each in given):
            return self.unknown(what)
        raise NotModelled(operations.STRINGS if isinstance(getattr(function, "__self__", None), str) else what)

    def _called_choice(self, function: Choice, given: tuple[Any, ...]) -> Any:
        result: Any = UNDEFINED
        for condition, option in function.options:
            self.memory.open(condition)
            found = self.called(option, given)
            self.memory.close()
            result = merged(condition, found, result)
        return result

    def _of_values(self, function: Any, name: str, given: tuple[Any, ...], named: dict[str, Any]) -> Any:
        if name in ("with_members", "copied", "shaped"):  # they only handle values, and assign to new objects
            return function(*given, **named)
        if all(map(is_known, given)):
            try:
                return function(*given)
            except values.LogicError as e:
                self.fail_if(True, e.message)
                return UNDEFINED
        if name in OF_VALUES:
            return OF_VALUES[name](self, given)
        if any(is_text(each) for each in given):
            raise NotModelled(operations.STRINGS)
        return self.run(function, given)
