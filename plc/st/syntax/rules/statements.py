"""The rules of the grammar for statements."""

from __future__ import annotations

from typing import Any

from lark import v_args
from lark.tree import Meta

from fieldtwin.plc.st.syntax import tree as t
from fieldtwin.plc.st.syntax.rules.base import Rules
from fieldtwin.plc.st.syntax.rules.charts import chart_of


@v_args(meta=True)
class StatementRules(Rules):
    """The methods of the transformer for statements."""

    def body(self, meta: Meta, items: list[Any]) -> tuple[t.Statement, ...]:
        statements: list[t.Statement] = []
        for item in items:
            statements += item if isinstance(item, list) else [item] if item is not None else []
        return tuple(statements)

    pou_body = action_body = body

    def action(self, meta: Meta, items: list[Any]) -> t.Action:
        name, parts = items
        body = tuple(i for i in parts if isinstance(i, t.Statement))
        return t.Action(self._pos(name), str(name), body, chart_of(parts))

    def empty(self, meta: Meta, items: list[Any]) -> None:
        return None

    def assign(self, meta: Meta, items: list[Any]) -> list[t.Assign]:
        """Return one assignment, or those of ``a := b := value``: first that of the value, then of each variable."""
        *targets, value = items
        words = ["", *[t.CHAINED] * (len(targets) - 1)]
        return [
            t.Assign(self._pos(meta), target, given, word)
            for target, given, word in zip(reversed(targets), (value, *reversed(targets[1:])), words, strict=True)
        ]

    def refer(self, meta: Meta, items: list[Any]) -> t.Refer:
        return t.Refer(self._pos(meta), items[0], items[1])

    def latch(self, meta: Meta, items: list[Any]) -> t.If:
        target, word, condition = items
        constant = t.Literal(self._pos(word), *(["TRUE"] * 2 if word[0] in "Ss" else ["FALSE"] * 2))
        assign = t.Assign(self._pos(meta), target, constant, word.upper())
        return t.If(self._pos(meta), ((condition, (assign,)),), ())

    def attempt(self, meta: Meta, items: list[Any]) -> t.Attempt:
        return t.Attempt(self._pos(meta), items[0], items[1])

    def call_statement(self, meta: Meta, items: list[Any]) -> t.CallStatement:
        return t.CallStatement(self._pos(meta), items[0])

    def if_statement(self, meta: Meta, items: list[Any]) -> t.If:
        otherwise = items.pop()[1] if len(items) % 2 else ()
        return t.If(self._pos(meta), tuple(zip(items[::2], items[1::2], strict=True)), otherwise)

    def else_part(self, meta: Meta, items: list[Any]) -> tuple[str, tuple[t.Statement, ...]]:
        return "else", items[0]

    def case_statement(self, meta: Meta, items: list[Any]) -> t.Case:
        selector, *rest = items
        has_else = bool(rest) and rest[-1][0] == "else"
        otherwise = rest.pop()[1] if has_else else ()
        return t.Case(self._pos(meta), selector, tuple(rest), otherwise, has_else)

    def case_branch(self, meta: Meta, items: list[Any]) -> tuple[tuple[t.CaseLabel, ...], tuple[t.Statement, ...]]:
        return tuple(items[:-1]), items[-1]

    def case_label(self, meta: Meta, items: list[Any]) -> t.CaseLabel:
        return t.CaseLabel(self._pos(meta), items[0], items[1] if len(items) > 1 else None)

    def next_label(self, meta: Meta, items: list[Any]) -> t.CaseLabel:
        return t.CaseLabel(self._pos(meta), items[0], items[1] if len(items) > 1 else None)

    def case_number(self, meta: Meta, items: list[Any]) -> t.Expr:
        literal = t.Literal(self._pos(meta), items[-1].type, str(items[-1]))
        return t.Unary(self._pos(meta), "-", literal) if str(items[0]) == "-" else literal

    def case_name(self, meta: Meta, items: list[Any]) -> t.Expr:
        first, *members = [name for item in items for name in str(item).split(".")]
        return t.Ref(self._pos(meta), first, tuple(t.Member(self._pos(meta), name) for name in members))

    def case_enum(self, meta: Meta, items: list[Any]) -> t.Expr:
        return t.Literal(self._pos(meta), "ENUM_REF", str(items[0]))

    def for_statement(self, meta: Meta, items: list[Any]) -> t.For:
        variable, first, last, *step, body = items
        return t.For(self._pos(meta), variable, first, last, step[0] if step else None, body)

    def while_statement(self, meta: Meta, items: list[Any]) -> t.While:
        return t.While(self._pos(meta), items[0], items[1])

    def repeat_statement(self, meta: Meta, items: list[Any]) -> t.Repeat:
        return t.Repeat(self._pos(meta), items[0], items[1])

    def exit(self, meta: Meta, items: list[Any]) -> t.Jump:
        return t.Jump(self._pos(meta), "EXIT")

    def continue_(self, meta: Meta, items: list[Any]) -> t.Jump:
        return t.Jump(self._pos(meta), "CONTINUE")

    def return_(self, meta: Meta, items: list[Any]) -> t.Jump:
        return t.Jump(self._pos(meta), "RETURN")
