"""The text of an expression in Structured Text: on one line, and with as few parentheses as possible."""

from __future__ import annotations

from fieldtwin.plc.st.syntax import tree as t

_LEVELS = (
    ("OR", "OR_ELSE"),
    ("XOR",),
    ("AND", "&", "AND_THEN"),
    ("=", "<>"),
    ("<", ">", "<=", ">="),
    ("+", "-"),
    ("*", "/", "MOD"),
    ("**",),
)
"""The binary operators, loosest first (IEC 61131-3:2013, table 71)."""
_LEVEL = {op: level for level, ops in enumerate(_LEVELS) for op in ops}
_LETTERS = {8: "B", 16: "W", 32: "D", 64: "L"}
_UNARY = len(_LEVELS)


def text_of(expr: t.Expr) -> str:
    """Return an expression as Structured Text. Comments and line breaks of the source are not kept."""
    return _text(expr, 0)


def _text(expr: t.Expr, level: int) -> str:
    """Return the text of an expression, in parentheses if its operator binds less than `level`."""
    if isinstance(expr, t.Literal):
        return expr.text
    if isinstance(expr, t.Ref):
        return reference(expr)
    if isinstance(expr, t.Call):
        return f"{reference(expr.ref)}({', '.join(map(_argument, expr.arguments))})"
    if isinstance(expr, t.Unary):
        space = " " if expr.op.isalpha() else ""
        return _within(f"{expr.op}{space}{_text(expr.operand, _UNARY)}", _UNARY, level)
    own = _LEVEL[expr.op]
    return _within(f"{_text(expr.left, own)} {expr.op} {_text(expr.right, own + 1)}", own, level)


def _within(text: str, own: int, level: int) -> str:
    return f"({text})" if own < level else text


def reference(ref: t.Ref) -> str:
    """Return a variable with its members, bits and indices."""
    return (text_of(ref.of) if ref.of is not None else ref.name) + "".join(map(_selector, ref.selectors))


def case_label(label: t.CaseLabel) -> str:
    """Return a label of a CASE: a value or a range."""
    return text_of(label.low) if label.high is None else f"{text_of(label.low)}..{text_of(label.high)}"


def _selector(selector: t.Selector) -> str:
    if isinstance(selector, t.Deref):
        return "^"
    if isinstance(selector, t.Member):
        return f".{selector.name}"
    if isinstance(selector, t.Bit):
        return f".{selector.number}" if selector.size == 1 else f".%{_LETTERS[selector.size]}{selector.number}"
    return f"[{', '.join(map(text_of, selector.indices))}]"


def _argument(argument: t.Argument) -> str:
    if argument.target is not None:
        return f"{'NOT ' if argument.inverted else ''}{argument.name} => {reference(argument.target)}"
    value = text_of(argument.value) if argument.value is not None else ""
    return f"{argument.name} := {value}" if argument.name else value
