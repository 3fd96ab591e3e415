"""The conditions of scenarios, invariants and alarms: ``quality(ctd.pressure) != 'good' or age(ctd.pressure) <= 1.5 s``.

`fieldtwin.gateway.core.expressions` defines their grammar. Names are tags and programs' variables, and any value may be unknown.
"""

from __future__ import annotations

import ast
from collections.abc import Callable, Collection, Iterable, Mapping
from itertools import pairwise
from math import isnan
from typing import Any

from fieldtwin.gateway.core.conditions.decimals import as_decimal
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.gateway.core.expressions import ARITHMETIC, COMPARE, OF_NUMBERS, NotUnderstood, Parsed, dotted
from fieldtwin.gateway.core.files.nearest import did_you_mean
from fieldtwin.gateway.core.values import Quality, Reason

FUNCTIONS = ("quality", "age", "value", "updates", "reason")
"""Functions of a tag: its quality in words, the seconds since its source's time, its value, how often it was published,
and the reason why it is bad.
"""
QUALITIES = tuple(str(quality) for quality in Quality)
WORDS = {"quality": QUALITIES, "reason": tuple(str(reason).replace(" ", "_") for reason in Reason)}
"""The possible results of these functions."""
Words = Collection[str]
"""The texts that a name can equal. A mapping gives the number of each text: the name's value is a number."""
NO_WORDS: Mapping[str, Words] = {}
_OWN = ("plc.late", "command_pending")
"""``plc.late``: the seconds by which the last scan was late; ``command pending``: a remote command was sent in the last 5 s."""
_NAMED = ast.Name | ast.Attribute | ast.Subscript
"""The nodes that are names of tags and variables."""
Look = Callable[[str, str], Any]
"""``look(function, name)`` returns the current value of a function of a tag or variable, or None if it is unknown."""


def parsed(text: str) -> Parsed:
    """Return the syntax tree of a condition. Raises `UsageError` for an invalid text."""
    return Parsed(text, "expression", "for example: relay.state == 'ACTIVE'", indices=True)


def names_in_text(text: str) -> list[str]:
    """Return the tags and variables in a condition, without knowing which exist; an empty list for an invalid condition."""
    try:
        found = parsed(text)
    except UsageError:
        return []
    names, waiting = [], [found.tree]
    while waiting:
        node = waiting.pop()
        if isinstance(node, _NAMED):
            names.append(dotted(node))
        elif isinstance(node, ast.Call):
            waiting += node.args
        else:
            waiting += [part for part in ast.iter_child_nodes(node) if isinstance(part, ast.expr)]
    return names


class UnknownName(NotUnderstood):
    """An expression contains a `name` that the system does not have. `others` are the errors of its further unknown names."""

    def __init__(self, name: str, error: NotUnderstood) -> None:
        super().__init__(error.message, error.at_column, expected=error.expected, hint=error.hint)
        self.name = name
        self.others: list[UnknownName] = []


class Expression:
    """An expression, parsed once from `text`. `names` are the tags and variables in it. Raises `UsageError` for an
    invalid expression.

    `words` gives, for some names, the texts that they can equal; comparing such a name with a different text is an
    error. A text for which `words` has a number is replaced by that number. `prefix` is put before each name when it is
    evaluated: in a network, the name of the system and a dot. An error for an unknown name suggests one of `known` and `near`.
    """

    def __init__(
        self,
        text: str,
        known: Collection[str],
        words: Mapping[str, Words] = NO_WORDS,
        prefix: str = "",
        near: Collection[str] = (),
    ) -> None:
        self.text = text
        self.names: list[str] = []
        self._parsed = parsed(text)
        self._tree = self._parsed.tree
        self.times_s = self._parsed.times_s
        """The times that the expression contains, in seconds."""
        self.asks_lateness = False
        """Whether the expression contains ``plc.late``."""
        self.asks: set[str] = set()
        """The functions of tags in the expression, and ``plc.late`` and ``command_pending`` if it contains them."""
        self._known, self._near = known, near
        self._words = words
        self._prefix = prefix
        self._unknown: list[UnknownName] = []
        self._check(self._tree)
        if self._unknown:
            first = self._unknown[0]
            first.others = self._unknown[1:]
            raise first

    def evaluate(self, look: Look) -> Any:
        """Return the expression's value now, or None if the value is unknown.

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
        """Return whether the expression contains no tag or variable, and therefore never changes."""
        return not any(isinstance(node, ast.Name | ast.Attribute | ast.Call) for node in ast.walk(self._tree))

    def _check(self, node: ast.expr) -> None:
        if isinstance(node, ast.Call):
            self._check_call(node)
            return
        if isinstance(node, _NAMED):
            self._check_name(node)
            return
        if isinstance(node, ast.Compare):
            for one, other in pairwise([node.left, *node.comparators]):
                self._check_words(one, other)
                self._check_words(other, one)
        for part in ast.iter_child_nodes(node):
            if isinstance(part, ast.expr):
                self._check(part)

    def _check_call(self, node: ast.Call) -> None:
        name = dotted(node.func)
        if name in OF_NUMBERS and len(node.args) == OF_NUMBERS[name][0]:
            for part in node.args:
                self._check(part)
        elif name in FUNCTIONS and len(node.args) == 1 and dotted(node.args[0]):
            self.asks.add(name)
            self._check_name(node.args[0])
        else:
            expected = ", ".join(f"{f}(TAG)" for f in FUNCTIONS)
            if name in OF_NUMBERS:
                expected = f"{OF_NUMBERS[name][0]} argument(s)"
            hint = did_you_mean(name, (*FUNCTIONS, *OF_NUMBERS))
            raise self._parsed.error(f"no function {name!r}", node, expected=expected, hint=hint)

    def _check_words(self, asked: ast.expr, text: ast.expr) -> None:
        """Check a text that is compared with `asked`, and replace the name of a number by the number.

        Raises an error for a text that `asked` can never equal.
        """
        if not isinstance(text, ast.Constant) or not isinstance(text.value, str):
            return
        words: Words = ()
        if isinstance(asked, _NAMED):
            words = self._words.get(dotted(asked), ())
        elif isinstance(asked, ast.Call) and isinstance(asked.func, ast.Name) and len(asked.args) == 1:
            value = asked.func.id == "value" and isinstance(asked.args[0], _NAMED)
            words = self._words.get(dotted(asked.args[0]), ()) if value else WORDS.get(asked.func.id, ())
        if isinstance(words, Mapping) and text.value in words:
            text.value = words[text.value]
        elif isinstance(words, Mapping) and not words:
            raise self._parsed.error(
                f"{ast.unparse(asked)} is a number, and {text.value!r} is a text", text, expected="a number"
            )
        elif words and text.value not in words:
            raise self._parsed.error(
                f"{ast.unparse(asked)} is never {text.value!r}",
                text,
                expected=", ".join(words),
                hint=did_you_mean(text.value, words),
            )

    def _check_name(self, node: ast.expr) -> None:
        name = dotted(node)
        if name in ("true", "false", "plc.late", "command_pending"):
            self.asks_lateness |= name == "plc.late"
            self.asks |= {name} & set(_OWN)
            return
        if name not in self._known:
            hint = did_you_mean(name, [*self._known, *self._near])
            expected = "DEVICE.TAG or PROGRAM.VARIABLE"
            error = self._parsed.error(f"no tag or variable {name!r}", node, expected=expected, hint=hint)
            self._unknown.append(UnknownName(name, error))
        self.names.append(self._prefix + name)


def _value(node: ast.expr, look: Look) -> Any:
    if isinstance(node, ast.Constant):
        return node.value
    if isinstance(node, _NAMED):
        name = dotted(node)
        return name == "true" if name in ("true", "false") else _known(as_decimal(look("value", name)))
    if isinstance(node, ast.Call):
        function = dotted(node.func)
        if function in OF_NUMBERS:
            return _computed(OF_NUMBERS[function][1], *(_value(part, look) for part in node.args))
        found = look(function, dotted(node.args[0]))
        return _known(as_decimal(found) if function == "value" else found)
    if isinstance(node, ast.IfExp):
        chosen = _truth(_value(node.test, look))
        return None if chosen is None else _value(node.body if chosen else node.orelse, look)
    if isinstance(node, ast.BoolOp):
        return _joined((_truth(_value(part, look)) for part in node.values), isinstance(node.op, ast.Or))
    if isinstance(node, ast.UnaryOp):
        inner = _value(node.operand, look)
        if isinstance(node.op, ast.Not):
            true = _truth(inner)
            return None if true is None else not true
        return None if inner is None or isinstance(inner, str) else -inner
    if isinstance(node, ast.BinOp):
        return _computed(ARITHMETIC[type(node.op)], _value(node.left, look), _value(node.right, look))
    assert isinstance(node, ast.Compare)
    values = [_value(part, look) for part in (node.left, *node.comparators)]
    pairs = zip(node.ops, pairwise(values), strict=True)
    return _joined((_applied(COMPARE[type(op)], *pair) for op, pair in pairs), stop_at=False)


def _known(value: Any) -> Any:
    """Return the value, or None for NaN, which means "no number"."""
    return None if isinstance(value, float) and isnan(value) else value


def _truth(value: Any) -> bool | None:
    return None if value is None else bool(value)


def _joined(parts: Iterable[bool | None], stop_at: bool) -> bool | None:
    """Return `or` (`stop_at` True) or `and` (False) of `parts` in Kleene's three-valued logic."""
    unknown = False
    for part in parts:
        if part is stop_at:
            return stop_at
        unknown |= part is None
    return None if unknown else not stop_at


def _computed(operation: Callable[..., Any], *operands: Any) -> Any:
    """Return the result of an operation on numbers as `_applied` does; None for texts, which Python would repeat or join."""
    return None if any(isinstance(operand, str) for operand in operands) else _applied(operation, *operands)


def _applied(operation: Callable[..., Any], *operands: Any) -> Any:
    """Return the operation's result; None if an operand is unknown or the operation has no result."""
    if None in operands:
        return None
    try:
        return _known(operation(*operands))
    except (TypeError, ValueError, ArithmeticError):
        return None
