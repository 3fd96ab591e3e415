"""The language of expressions: ``quality(ctd.pressure) != 'good' or age(ctd.pressure) <= 1.5 s``, ``demand - speed * dt / 0.8``.

It is a part of Python's expressions, read by Python's parser; no code is ever executed. A time such as ``1.5 s`` is a number
of seconds. Two modules evaluate it: conditions of scenarios, invariants and what-if questions, where a value may be unknown or
a text (`fieldtwin.gateway.core.conditions.expression`), and formulas of simulations, which are compiled, with floats only
(`fieldtwin.emulators.simulation.formula`). The only names that this module knows are those of the functions of numbers.
"""

from __future__ import annotations

import ast
import math
import operator
import re
from collections.abc import Callable
from typing import Any

from fieldtwin.gateway.core.errors import UsageError

LONGEST = 1000
"""The largest number of characters of an expression."""
DEEPEST = 50
"""The largest number of nested levels of an expression."""

_UNIT_S = {"ms": 0.001, "s": 1.0, "min": 60.0, "h": 3600.0}
_TOKEN = re.compile(r"""('[^']*'|"[^"]*")|(?<![\w.])(\d+(?:\.\d+)?)\s*(ms|min|s|h)\b|(command pending)""")
COMPARE: dict[type[ast.cmpop], Callable[[Any, Any], Any]] = {
    ast.Eq: operator.eq,
    ast.NotEq: operator.ne,
    ast.Lt: operator.lt,
    ast.LtE: operator.le,
    ast.Gt: operator.gt,
    ast.GtE: operator.ge,
}
ARITHMETIC: dict[type[ast.operator], Callable[[Any, Any], Any]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Mod: math.fmod,
    ast.Pow: math.pow,
}


def clamp(x: float, low: float, high: float) -> float:
    """Return `x`, at least `low` and at most `high`."""
    return min(max(x, low), high)


def _deadband(x: float, width: float) -> float:
    return 0.0 if abs(x) <= width else x


OF_NUMBERS: dict[str, tuple[int, Callable[..., float]]] = {
    "abs": (1, abs),
    "atan2": (2, lambda y, x: math.atan2(y + 0.0, x + 0.0)),  # -0.0 as 0.0: a whole number has only one zero
    "clamp": (3, clamp),
    "cos": (1, math.cos),
    "deadband": (2, _deadband),
    "exp": (1, math.exp),
    "floor": (1, math.floor),
    "hypot": (2, math.hypot),
    "log": (1, math.log),
    "max": (2, max),
    "min": (2, min),
    "round": (1, round),
    "sin": (1, math.sin),
    "sqrt": (1, math.sqrt),
    "tan": (1, math.tan),
}
"""The functions of numbers, by name: the number of their arguments, and Python's function. Angles are in radians."""


class NotUnderstood(UsageError):
    """The text is not an expression, or contains an unknown name.

    `at_column` is the position of the error: characters after the start of the text.
    """

    at_column = 0

    def __init__(self, message: str, at_column: int, *, expected: str = "", got: str = "", hint: str = "") -> None:
        super().__init__(message, expected=expected, got=got, hint=hint)
        self.at_column = at_column


class Parsed:
    """The syntax tree of a text, which contains only nodes of this language. `what` names the text in errors: "formula". With
    `indices` names may contain indices of arrays, such as ``tank.levels[3]``.

    `times_s` are the times that it contains, in seconds. Raises `UsageError` for an invalid text, with `hint` for one
    that Python's parser refuses.
    """

    def __init__(self, text: str, what: str, hint: str, *, indices: bool = False) -> None:
        self.text = text
        self._indices = indices
        self.times_s = [float(m[2]) * _UNIT_S[m[3]] for m in _TOKEN.finditer(text) if m[2] is not None]
        self._what = what
        if len(text) > LONGEST:
            raise UsageError(f"the {what} is too long", expected=f"at most {LONGEST} characters", got=f"{len(text)}")
        self._lead = len(text) - len(text.lstrip())
        self._plain = _TOKEN.sub(_plain, text[self._lead :]).rstrip()
        try:
            self.tree = ast.parse(self._plain, mode="eval").body
        except (SyntaxError, ValueError, RecursionError, MemoryError) as e:
            at = (e.offset or 1) - 1 if isinstance(e, SyntaxError) and (e.lineno or 1) == 1 else 0
            raise NotUnderstood(f"no {what}", self._column(at), got=text, hint=hint) from e
        self._check(self.tree, 0)

    def error(
        self, message: str, node: ast.expr, *, expected: str = "", got: str = "", hint: str = ""
    ) -> NotUnderstood:
        """Return an error at the position of `node`, converted to characters, since Python's parser counts bytes of UTF-8."""
        at = self._column(len(self._plain.encode()[: node.col_offset].decode(errors="ignore")))
        return NotUnderstood(message, at, expected=expected, got=got, hint=hint)

    def _column(self, at: int) -> int:
        """Return the position in `text` that corresponds to character `at` of the modified text given to Python's parser."""
        grown = 0
        for match in _TOKEN.finditer(self.text, self._lead):
            begins = match.start() - self._lead + grown
            longer = len(_plain(match)) - len(match.group())
            if at < begins:
                break
            if at < begins + len(match.group()) + longer:
                return match.start()
            grown += longer
        return min(self._lead + at - grown, len(self.text))

    def _check(self, node: ast.expr, depth: int) -> None:
        if depth > DEEPEST:
            raise UsageError(
                f"the {self._what} is nested too deeply", expected=f"at most {DEEPEST} levels", got=self.text
            )
        match node:
            case ast.Constant(value=bool() | int() | float() | str()):
                parts: list[ast.expr] = []
            case ast.Name() | ast.Attribute():
                self._check_name(node)
                parts = []
            case ast.Subscript() if self._indices:
                self._check_name(node)
                parts = []
            case ast.Call(func=name, args=parts, keywords=[]):
                self._check_name(name)
            case ast.BoolOp(values=parts):
                pass
            case ast.UnaryOp(op=ast.Not() | ast.USub(), operand=operand):
                parts = [operand]
            case ast.BinOp(left=left, op=op, right=right) if type(op) in ARITHMETIC:
                parts = [left, right]
            case ast.Compare(left=left, ops=ops, comparators=others) if all(type(op) in COMPARE for op in ops):
                parts = [left, *others]
            case ast.IfExp(test=test, body=body, orelse=other):
                parts = [test, body, other]
            case _:
                expected = "numbers, texts, names, + - * / % **, comparisons, and, or, not, `A if B else C`, functions"
                raise self.error("not understood", node, got=ast.unparse(node), expected=expected)
        for part in parts:
            self._check(part, depth + 1)

    def _check_name(self, node: ast.expr) -> None:
        inner = node
        while isinstance(inner, ast.Attribute | ast.Subscript):
            if isinstance(inner, ast.Subscript) and not (self._indices and _index(inner.slice)):
                raise self.error(
                    "not the index of an array", inner.slice, expected="a number, such as levels[3] or map[1, 2]"
                )
            inner = inner.value
        if not isinstance(inner, ast.Name):
            raise self.error("not a name", node, got=ast.unparse(inner))


def dotted(node: ast.expr) -> str:
    """Return the name that a node of a `Parsed` tree represents, such as ``ctd.pressure``; "" for any other node."""
    if isinstance(node, ast.Attribute):
        return f"{dotted(node.value)}.{node.attr}"
    if isinstance(node, ast.Subscript):
        return f"{dotted(node.value)}[{_index(node.slice)}]"
    return node.id if isinstance(node, ast.Name) else ""


def _index(node: ast.expr) -> str:
    """Return the indices of an array as they are written in paths, such as ``3`` or ``1,-2``; "" for other expressions."""
    numbers = []
    for one in node.elts if isinstance(node, ast.Tuple) else [node]:
        negative = isinstance(one, ast.UnaryOp) and isinstance(one.op, ast.USub)
        number = one.operand if isinstance(one, ast.UnaryOp) and negative else one
        if not (isinstance(number, ast.Constant) and type(number.value) is int):
            return ""
        numbers.append(f"{'-' if negative else ''}{number.value}")
    return ",".join(numbers)


def _plain(match: re.Match[str]) -> str:
    text, number, unit, pending = match.groups()
    if text is not None:
        return str(text)
    return "command_pending" if pending else f"({float(number) * _UNIT_S[unit]!r})"
