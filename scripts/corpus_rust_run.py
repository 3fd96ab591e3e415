"""Execute functions of a file of unit tests in Rust that `corpus_rust` has read.

The functions, methods and types of the tested program come from a subclass of `Interpreter`. Numbers are those of Python: they
get a width only where they are converted (``as u16``).
"""

from __future__ import annotations

import math
import operator
import re
import struct
from collections.abc import Callable, Sequence
from itertools import product
from typing import Any

from corpus_rust import Expression, Function, NotRead, RustFile

MAX_CALLS = 50
"""How deep functions of the file may call each other."""
CONSTANTS = {
    "PI": math.pi, "E": math.e, "SQRT_2": math.sqrt(2), "FRAC_PI_2": math.pi / 2, "FRAC_PI_4": math.pi / 4,
}  # fmt: skip
_TYPE = re.compile(r"([iuf])(\d+)$")
_OPERATORS: dict[str, Callable[[Any, Any], Any]] = {
    "+": operator.add, "-": operator.sub, "*": operator.mul,
    "<": operator.lt, ">": operator.gt, "<=": operator.le, ">=": operator.ge,
}  # fmt: skip
_UNCHANGED = {"unwrap", "clone", "to_string", "into", "as_str", "iter", "as_ref"}
"""The methods that return the value itself, which has no owner and no type here."""


class Differs(Exception):
    """The text names the expectation of the test that does not hold."""


class Interpreter:
    """Executes the functions of a file. `calls` are the functions of the tested program, by their names in the file."""

    def __init__(self, file: RustFile, calls: dict[str, Callable[..., Any]]) -> None:
        self.file, self.calls, self.depth = file, calls, 0

    # -- what a subclass knows ----------------------------------------------------------------------------------------

    def known(self, name: str) -> Any:
        """Return the value of a name that the file does not declare."""
        raise NotRead(f"the name {name}")

    def member(self, of: Any, name: str) -> Any:
        raise NotRead(f"the member {name}")

    def method(self, of: Any, name: str, generic: str, given: list[Any]) -> Any:
        raise NotRead(f"the method {name}")

    def structure(self, name: str, fields: dict[str, Any]) -> Any:
        raise NotRead(f"the structure {name}")

    def literal(self, macro: str, text: str) -> Any:
        """Return the value of a macro whose arguments are not expressions, such as ``date!(2000-01-01)``."""
        raise NotRead(f"the macro {macro}")

    def same(self, left: Any, right: Any) -> bool:
        return bool(left == right)

    def shown(self, value: Any) -> str:
        return repr(value)

    # -- functions ----------------------------------------------------------------------------------------------------

    def cases(self, function: Function) -> dict[str, list[Any]]:
        """Return the arguments of a test by the names of its cases; a name is empty for the only case.

        With values for its parameters it has a case for each combination, whose name has the numbers of the values.
        """
        if function.cases:
            return {name: self.values(of(), {}) for name, of in function.cases.items()}
        if function.values:
            choices = [list(enumerate(self.values(of(), {}), 1)) for of in function.values.values()]
            return {"::".join(str(n) for n, _ in one): [value for _, value in one] for one in product(*choices)}
        return {"": []}

    def call(self, function: Function, arguments: Sequence[Any]) -> Any:
        self.depth += 1
        try:
            if self.depth > MAX_CALLS or len(arguments) != len(function.parameters):
                raise NotRead(f"the call of {function.name}")
            return self.value(function.body(), dict(zip(function.parameters, arguments, strict=True)))
        finally:
            self.depth -= 1

    # -- expressions --------------------------------------------------------------------------------------------------

    def values(self, expressions: Sequence[Expression], scope: dict[str, Any]) -> list[Any]:
        return [self.value(e, scope) for e in expressions]

    def value(self, of: Expression, scope: dict[str, Any]) -> Any:
        """Return the value of an expression. `scope` has the variables, by their names."""
        match of:
            case ("value", value):
                return value
            case ("name", name, _):
                return self._named(name, scope)
            case ("tuple", items):
                return tuple(self.values(items, scope))
            case ("list", items):
                return self.values(items, scope)
            case ("cast", inner, kind):
                return converted(self.value(inner, scope), kind)
            case ("unary", sign, inner):
                return not self.value(inner, scope) if sign == "!" else -self.value(inner, scope)
            case ("binary", sign, left, right):
                return self._combined(sign, left, right, scope)
            case ("range", first, last, inclusive):
                return range(self.value(first, scope), self.value(last, scope) + inclusive)
            case ("index", inner, index):
                return self.value(inner, scope)[self.value(index, scope)]
            case ("block", statements):
                return self._block(statements, dict(scope))
            case ("closure", parameters, body):
                return lambda *given: self.value(body, scope | dict(zip(parameters, given, strict=True)))
            case ("struct", name, fields):
                return self.structure(name, {key: self.value(e, scope) for key, e in fields.items()})
            case ("field", inner, name):
                return self.member(self.value(inner, scope), name)
            case ("macro", name, arguments, text):
                return self._macro(name, arguments, text, scope)
            case ("call", ("name", name, generic), arguments):
                return self._called(name, generic, self.values(arguments, scope), scope)
            case ("method", inner, name, generic, arguments):
                return self._method(self.value(inner, scope), name, generic, self.values(arguments, scope))
        raise NotRead(f"an expression ({of[0]})")

    def _combined(self, sign: str, left: Expression, right: Expression, scope: dict[str, Any]) -> Any:
        first = self.value(left, scope)
        if sign in ("&&", "||"):
            return bool(self.value(right, scope)) if bool(first) == (sign == "&&") else bool(first)
        second = self.value(right, scope)
        if sign in ("==", "!="):
            return self.same(first, second) == (sign == "==")
        if sign not in _OPERATORS:
            raise NotRead(f"the operator {sign}")
        return _OPERATORS[sign](first, second)

    def _block(self, statements: Sequence[Expression], scope: dict[str, Any]) -> Any:
        last = None
        for statement in statements:
            match statement:
                case ("let", pattern, value):
                    bind(pattern, self.value(value, scope), scope)
                case ("for", pattern, over, body):
                    for one in self.value(over, scope):
                        bind(pattern, one, scope)
                        self.value(body, scope)
                case _:
                    last = self.value(statement, scope)
        return last

    def _named(self, name: str, scope: dict[str, Any]) -> Any:
        first, _, last = name.rpartition("::")
        if name in scope:
            return scope[name]
        if name in self.file.constants:
            return self.value(self.file.constants[name](), {})
        if last in ("MAX", "MIN") and _TYPE.match(first):
            bits, signed = int(first[1:]), first[0] == "i"
            return ((1 << bits - signed) - 1) if last == "MAX" else -(1 << bits - 1) * signed
        return CONSTANTS[last] if first.endswith("consts") and last in CONSTANTS else self.known(name)

    def _called(self, name: str, generic: str, given: list[Any], scope: dict[str, Any]) -> Any:
        if callable(scope.get(name)):
            return scope[name](*given)
        if name in self.calls:
            return self.calls[name](*given, **({"generic": generic} if generic else {}))
        if name in self.file.functions:
            return self.call(self.file.functions[name], given)
        raise NotRead(f"the call of {name}")

    def _method(self, of: Any, name: str, generic: str, given: list[Any]) -> Any:
        match of, name:
            case (int() | float(), "abs"):
                return abs(of)
            case (float(), "is_nan" | "is_infinite"):
                return math.isnan(of) if name == "is_nan" else math.isinf(of)
            case (str(), "repeat"):
                return of * given[0]
        try:
            return self.method(of, name, generic, given)
        except NotRead:
            if name in _UNCHANGED:
                return of
            raise

    def _macro(self, name: str, arguments: Callable[[], list[Expression]], text: str, scope: dict[str, Any]) -> Any:
        match name:
            case "format":
                first, *rest = arguments()
                named = {of[1]: self.value(of[2], scope) for of in rest if of[0] == "let"}
                positional = [self.value(of, scope) for of in rest if of[0] != "let"]
                return self._formatted(self.value(first, scope), positional, scope | named)
            case "assert":
                if not self.value(arguments()[0], scope):
                    raise Differs("not met: " + re.split(r',\s*"', text)[0])
            case "assert_eq" | "assert_ne":
                left, right = self.values(arguments()[:2], scope)
                if self.same(left, right) == (name == "assert_ne"):
                    raise Differs(f"got {self.shown(left)}; expected {self.shown(right)}")
            case "vec":
                return self.values(arguments(), scope)
            case _:
                return self.literal(name, text)
        return None

    def _formatted(self, text: str, rest: list[Any], scope: dict[str, Any]) -> str:
        positional = iter(rest)

        def inserted(match: re.Match[str]) -> str:
            if match[0] in ("{{", "}}"):
                return match[0][0]
            return str(self._named(match[1], scope) if match[1] else next(positional))

        return re.sub(r"\{\{|\}\}|\{(\w*)(?::[^}]*)?\}", inserted, text)


def converted(value: Any, kind: str) -> Any:
    """Return a number as one of a type of Rust; an integer wraps around. Other types leave the value as it is."""
    found = _TYPE.match({"isize": "i64", "usize": "u64"}.get(kind, kind))
    if found is None:
        return value
    if found[1] == "f":
        return struct.unpack("<f", struct.pack("<f", value))[0] if found[2] == "32" else float(value)
    bits = int(found[2])
    number = int(value) & (1 << bits) - 1
    return number - (1 << bits) if found[1] == "i" and number >> bits - 1 else number


def bind(pattern: str | list[Any], value: Any, scope: dict[str, Any]) -> None:
    if isinstance(pattern, str):
        scope[pattern] = value
    else:
        for part, one in zip(pattern, value, strict=True):
            bind(part, one, scope)
