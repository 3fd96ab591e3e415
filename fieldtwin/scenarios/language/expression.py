"""The expressions of scenarios: ``quality(ctd.pressure) != 'good' or age(ctd.pressure) <= 1.5 s``.

They are a small part of Python's expressions, parsed with Python's parser and evaluated here; no code is ever executed.
Names are tags and programs' variables; numbers may have a unit of time and are then converted to seconds.
"""

from __future__ import annotations

import ast
import operator
import re
from collections.abc import Callable, Collection, Iterable, Mapping
from itertools import pairwise
from math import isnan
from typing import Any

from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.gateway.core.files.nearest import did_you_mean
from fieldtwin.gateway.core.values import Quality, Reason

FUNCTIONS = ("quality", "age", "value", "updates", "reason")
"""Functions of a tag: its quality in words, the seconds since its source's time, its value, how often it was published,
and the reason why it is bad.
"""
QUALITIES = tuple(str(quality) for quality in Quality)
WORDS = {"quality": QUALITIES, "reason": tuple(str(reason).replace(" ", "_") for reason in Reason)}
"""The possible results of these functions."""
NO_WORDS: Mapping[str, Collection[str]] = {}
_OWN = ("plc.late", "command_pending")
"""``plc.late``: the seconds by which the last scan was late; ``command pending``: the remote client commanded within 5 s."""
LONGEST = 1000
DEEPEST = 50
_UNIT_S = {"ms": 0.001, "s": 1.0, "min": 60.0, "h": 3600.0}
_TOKEN = re.compile(r"""('[^']*'|"[^"]*")|(\d+(?:\.\d+)?)\s*(ms|min|s|h)\b|(command pending)""")
_COMPARE: dict[type[ast.cmpop], Callable[[Any, Any], Any]] = {
    ast.Eq: operator.eq,
    ast.NotEq: operator.ne,
    ast.Lt: operator.lt,
    ast.LtE: operator.le,
    ast.Gt: operator.gt,
    ast.GtE: operator.ge,
}
_ARITHMETIC: dict[type[ast.operator], Callable[[Any, Any], Any]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
}


class NotUnderstood(UsageError):
    """The text is not an expression, or contains an unknown name.

    `at_column` is the position of the error: characters after the start of the text.
    """

    at_column = 0

    def __init__(self, message: str, at_column: int, *, expected: str = "", got: str = "", hint: str = "") -> None:
        super().__init__(message, expected=expected, got=got, hint=hint)
        self.at_column = at_column


Look = Callable[[str, str], Any]
"""``look(function, name)`` returns the current value of a function of a tag or variable, or None if it is unknown."""


class Expression:
    """An expression, parsed once from `text`. `names` are the tags and variables in it. Raises `UsageError` for an
    invalid expression.

    `words` gives, for some names, all values that they can have; comparing such a name with a different text is an
    error. `prefix` is put before each name when it is evaluated: in a network, the name of the system and a dot.
    """

    def __init__(
        self,
        text: str,
        known: Collection[str],
        words: Mapping[str, Collection[str]] = NO_WORDS,
        prefix: str = "",
    ) -> None:
        self.text = text
        self.names: list[str] = []
        self.times_s = [float(m[2]) * _UNIT_S[m[3]] for m in _TOKEN.finditer(text) if m[2] is not None]
        """The times that it contains, in seconds."""
        self.asks_lateness = False
        """Whether it contains ``plc.late``."""
        self._known = known
        self._words = words
        self._prefix = prefix
        if len(text) > LONGEST:
            raise UsageError("the expression is too long", expected=f"at most {LONGEST} characters")
        self._lead = len(text) - len(text.lstrip())
        self._plain = _TOKEN.sub(_plain, text[self._lead :]).rstrip()
        try:
            self._tree = ast.parse(self._plain, mode="eval").body
        except (SyntaxError, ValueError, RecursionError) as e:
            at = (e.offset or 1) - 1 if isinstance(e, SyntaxError) and (e.lineno or 1) == 1 else 0
            hint = "for example: relay.state == 'ACTIVE'"
            raise NotUnderstood("no expression", self._column(at), got=text, hint=hint) from e
        self._check(self._tree, 0)

    def evaluate(self, look: Look) -> Any:
        """Return its value now, or None if the value is unknown.

        An operation on an unknown operand is unknown, and so is one without a result, such as a division by zero. `and`
        and `or` follow Kleene's three-valued logic: ``false and unknown`` is false, ``true or unknown`` is true.
        """
        prefix = self._prefix
        if not prefix:
            return _value(self._tree, look)
        return _value(self._tree, lambda function, name: look(function, name if name in _OWN else prefix + name))

    def truth(self, look: Look) -> bool | None:
        """Return whether the expression is true now; None if that is unknown. Never treat None as true, nor as false."""
        return _truth(self.evaluate(look))

    @property
    def is_constant(self) -> bool:
        """Whether it contains no tag or variable, and therefore never changes."""
        return not any(isinstance(node, ast.Name | ast.Attribute | ast.Call) for node in ast.walk(self._tree))

    def _column(self, at: int) -> int:
        """Return the position in `text` that corresponds to character `at` of the text given to Python's parser."""
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

    def _at(self, node: ast.expr) -> int:
        """Return the position of a node in `text`. Python's parser counts bytes of UTF-8."""
        return self._column(len(self._plain.encode()[: node.col_offset].decode(errors="ignore")))

    def _check(self, node: ast.expr, depth: int) -> None:
        if depth > DEEPEST:
            raise UsageError("the expression is nested too deeply", got=self.text)
        if isinstance(node, ast.BoolOp):
            parts: list[ast.expr] = node.values
        elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not | ast.USub):
            parts = [node.operand]
        elif isinstance(node, ast.BinOp) and type(node.op) in _ARITHMETIC:
            parts = [node.left, node.right]
        elif isinstance(node, ast.Compare) and all(type(op) in _COMPARE for op in node.ops):
            parts = [node.left, *node.comparators]
            for one, other in pairwise(parts):
                self._check_words(one, other)
                self._check_words(other, one)
        elif isinstance(node, ast.Call):
            self._check_call(node)
            return
        elif isinstance(node, ast.Constant) and isinstance(node.value, bool | int | float | str):
            return
        elif isinstance(node, ast.Name | ast.Attribute):
            self._check_name(self._name(node), node)
            return
        else:
            raise NotUnderstood(
                "not understood",
                self._at(node),
                got=ast.unparse(node),
                expected="names, numbers, texts, comparisons, and, or, not",
            )
        for part in parts:
            self._check(part, depth + 1)

    def _check_call(self, node: ast.Call) -> None:
        name = self._name(node.func)
        if name not in FUNCTIONS or len(node.args) != 1 or node.keywords:
            hint = did_you_mean(name, FUNCTIONS)
            raise NotUnderstood(
                f"no function {name!r}", self._at(node), expected=", ".join(f"{f}(TAG)" for f in FUNCTIONS), hint=hint
            )
        self._check_name(self._name(node.args[0]), node.args[0])

    def _check_words(self, asked: ast.expr, text: ast.expr) -> None:
        """Refuse a text that the other side of a comparison can never equal."""
        if not isinstance(text, ast.Constant) or not isinstance(text.value, str):
            return
        words: Collection[str] = ()
        if isinstance(asked, ast.Name | ast.Attribute):
            words = self._words.get(self._name(asked), ())
        elif isinstance(asked, ast.Call) and isinstance(asked.func, ast.Name) and len(asked.args) == 1:
            value = asked.func.id == "value" and isinstance(asked.args[0], ast.Name | ast.Attribute)
            words = self._words.get(self._name(asked.args[0]), ()) if value else WORDS.get(asked.func.id, ())
        if words and text.value not in words:
            raise NotUnderstood(
                f"{ast.unparse(asked)} is never {text.value!r}",
                self._at(text),
                expected=", ".join(words),
                hint=did_you_mean(text.value, words),
            )

    def _name(self, node: ast.expr) -> str:
        try:
            return _dotted(node)
        except UsageError as e:
            raise NotUnderstood(e.message, self._at(node), got=e.got) from e

    def _check_name(self, name: str, node: ast.expr) -> None:
        if name in ("true", "false", "plc.late", "command_pending"):
            self.asks_lateness |= name == "plc.late"
            return
        if name not in self._known:
            hint = did_you_mean(name, self._known)
            expected = "DEVICE.TAG or PROGRAM.VARIABLE"
            raise NotUnderstood(f"no tag or variable {name!r}", self._at(node), expected=expected, hint=hint)
        self.names.append(self._prefix + name)


def _plain(match: re.Match[str]) -> str:
    text, number, unit, pending = match.groups()
    if text is not None:
        return str(text)
    return "command_pending" if pending else f"({float(number) * _UNIT_S[unit]!r})"


def _dotted(node: ast.expr) -> str:
    if isinstance(node, ast.Name):
        return node.id
    if isinstance(node, ast.Attribute):
        return f"{_dotted(node.value)}.{node.attr}"
    raise UsageError("not a name", got=ast.unparse(node))


def _value(node: ast.expr, look: Look) -> Any:
    if isinstance(node, ast.Constant):
        return node.value
    if isinstance(node, ast.Name | ast.Attribute):
        name = _dotted(node)
        return name == "true" if name in ("true", "false") else _known(look("value", name))
    if isinstance(node, ast.Call):
        return _known(look(_dotted(node.func), _dotted(node.args[0])))
    if isinstance(node, ast.BoolOp):
        return _joined((_truth(_value(part, look)) for part in node.values), isinstance(node.op, ast.Or))
    if isinstance(node, ast.UnaryOp):
        inner = _value(node.operand, look)
        if isinstance(node.op, ast.Not):
            true = _truth(inner)
            return None if true is None else not true
        return None if inner is None or isinstance(inner, str) else -inner
    if isinstance(node, ast.BinOp):
        left, right = _value(node.left, look), _value(node.right, look)
        texts = isinstance(left, str) or isinstance(right, str)  # Python would repeat and join texts
        return None if texts else _applied(_ARITHMETIC[type(node.op)], left, right)
    assert isinstance(node, ast.Compare)
    values = [_value(part, look) for part in (node.left, *node.comparators)]
    pairs = zip(node.ops, pairwise(values), strict=True)
    return _joined((_applied(_COMPARE[type(op)], *pair) for op, pair in pairs), stop_at=False)


def _known(value: Any) -> Any:
    """Return the value, or None for NaN, which means "no number"."""
    return None if isinstance(value, float) and isnan(value) else value


def _truth(value: Any) -> bool | None:
    return None if value is None else bool(value)


def _joined(parts: Iterable[bool | None], stop_at: bool) -> bool | None:
    """Return Kleene's `or` (`stop_at` True) or `and` (False) of `parts`."""
    unknown = False
    for part in parts:
        if part is stop_at:
            return stop_at
        unknown |= part is None
    return None if unknown else not stop_at


def _applied(operation: Callable[[Any, Any], Any], a: Any, b: Any) -> Any:
    """Return the operation's result; None if an operand is unknown or the operation has no result."""
    if a is None or b is None:
        return None
    try:
        return _known(operation(a, b))
    except (TypeError, ArithmeticError):
        return None
