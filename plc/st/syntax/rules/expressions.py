"""The rules of the grammar for expressions."""

from __future__ import annotations

from typing import Any

from lark import v_args
from lark.tree import Meta

from fieldtwin.plc.st.syntax import tree as t
from fieldtwin.plc.st.syntax.addresses import address_of
from fieldtwin.plc.st.syntax.rules.base import Bad, Rules, integer

_SIZES = {"X": 1, "B": 8, "W": 16, "D": 32, "L": 64}


@v_args(meta=True)
class ExpressionRules(Rules):
    """The methods of the transformer for expressions."""

    def binary(self, meta: Meta, items: list[Any]) -> t.Binary:
        return t.Binary(self._pos(items[1]), items[1].upper(), items[0], items[2])

    def unary(self, meta: Meta, items: list[Any]) -> t.Unary:
        return t.Unary(self._pos(meta), items[0].upper(), items[1])

    def call(self, meta: Meta, items: list[Any]) -> t.Call:
        ref, *given = items
        empty = next((each for each in given if isinstance(each, t.Pos)), None)
        arguments = tuple(each for each in given if not isinstance(each, t.Pos))
        return t.Call(self._pos(meta), ref, arguments, empty)

    def negation(self, meta: Meta, items: list[Any]) -> t.Call:
        operator, *arguments = items
        return t.Call(self._pos(meta), t.Ref(self._pos(meta), str(operator)), tuple(arguments))

    def left_out(self, meta: Meta, items: list[Any]) -> t.Pos:
        return self._pos(meta)

    left_comma = left_out

    def operator(self, meta: Meta, items: list[Any]) -> t.Ref:
        return t.Ref(self._pos(meta), str(items[0]))

    def positional(self, meta: Meta, items: list[Any]) -> t.Argument:
        return t.Argument(self._pos(meta), "", items[0])

    def named(self, meta: Meta, items: list[Any]) -> t.Argument:
        return t.Argument(self._pos(meta), str(items[0]), items[1])

    def output(self, meta: Meta, items: list[Any]) -> t.Argument:
        return t.Argument(self._pos(meta), str(items[-2]), None, items[-1], inverted=len(items) == 3)

    def reference(self, meta: Meta, items: list[Any]) -> t.Ref:
        name, *selectors = items
        if name.type != "DIRECT":
            return t.Ref(self._pos(meta), "".join(name.split()), tuple(selectors))  # THIS ^ is THIS^
        address = address_of(name)
        if not address:
            raise Bad(name, "an address without a number is allowed in a declaration only")
        return t.Ref(self._pos(meta), address, tuple(selectors))

    def of_call(self, meta: Meta, items: list[Any]) -> t.Ref:
        call, *selectors = items
        return t.Ref(self._pos(meta), "", tuple(selectors), call)

    def member(self, meta: Meta, items: list[Any]) -> t.Member:
        return t.Member(self._pos(meta), str(items[0]))

    def bit(self, meta: Meta, items: list[Any]) -> t.Bit:
        (token,) = items
        if token.type == "PARTIAL":
            return t.Bit(self._pos(meta), int(token[2:]), _SIZES[token[1].upper()])
        return t.Bit(self._pos(meta), integer(token))

    def index(self, meta: Meta, items: list[Any]) -> t.Index:
        return t.Index(self._pos(meta), tuple(items))

    def deref(self, meta: Meta, items: list[Any]) -> t.Deref:
        return t.Deref(self._pos(meta))

    def literal(self, meta: Meta, items: list[Any]) -> t.Literal:
        return t.Literal(self._pos(meta), items[0].type, str(items[0]))
