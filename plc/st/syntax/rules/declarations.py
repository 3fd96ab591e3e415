"""The rules of the grammar for types and variables."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from lark import Token, v_args
from lark.tree import Meta

from fieldtwin.plc.st.syntax import tree as t
from fieldtwin.plc.st.syntax.rules.base import Bad, Bases, Rules, integer


@v_args(meta=True)
class DeclarationRules(Rules):
    """The methods of the transformer for types and variables."""

    def global_vars(self, meta: Meta, items: list[Any]) -> t.VarBlock:
        return self.var_block(meta, items)

    def var_block(self, meta: Meta, items: list[Any]) -> t.VarBlock:
        kind, *rest = items
        qualifiers = frozenset(i.upper() for i in rest if isinstance(i, str))
        variables = tuple(v for i in rest if not isinstance(i, str) for v in i)
        return t.VarBlock(self._pos(kind), kind.upper(), qualifiers, variables)

    def qualifier(self, meta: Meta, items: list[Any]) -> str:
        return str(items[0])

    def var_decl(self, meta: Meta, items: list[Any]) -> list[t.VarDecl]:
        names = [i for i in items if isinstance(i, Token)]
        location = next((i[1] for i in items if isinstance(i, tuple) and i[0] == "at"), "")
        spec, initial = spec_of(items), initial_of(items)
        edge = next((i[1] for i in items if isinstance(i, tuple) and i[0] == "edge"), "")
        return [t.VarDecl(self._pos(n), str(n), spec, initial, location, edge) for n in names]

    def location(self, meta: Meta, items: list[Any]) -> tuple[str, str]:
        return "at", str(items[0])

    def edge(self, meta: Meta, items: list[Any]) -> tuple[str, str]:
        return "edge", str(items[0]).upper()

    def initial(self, meta: Meta, items: list[Any]) -> tuple[str, t.Init]:
        return "initial", items[0]

    def field(self, meta: Meta, items: list[Any]) -> list[t.VarDecl]:
        return self.var_decl(meta, items)

    def type_block(self, meta: Meta, items: list[Any]) -> list[Any]:
        if not (items and isinstance(items[0], Token)):
            return items
        pragma, *types = items
        packed = max(1, int(pragma.rstrip("} \t\n")[-2]))
        return [replace(one, packed=packed) if isinstance(one, t.StructDecl) else one for one in types]

    def struct_decl(self, meta: Meta, items: list[Any]) -> t.StructDecl:
        name, *rest = items
        fields = tuple(v for group in rest if isinstance(group, list) for v in group)
        bases = next((i.names for i in rest if isinstance(i, Bases)), ())
        return t.StructDecl(self._pos(name), str(name), fields, extends=bases)

    def union_decl(self, meta: Meta, items: list[Any]) -> t.StructDecl:
        return replace(self.struct_decl(meta, items), union=True)

    def enum_decl(self, meta: Meta, items: list[Any]) -> t.EnumDecl:
        name, *rest = items
        bases = [t.NamedType(self._pos(i), str(i)) for i in rest if isinstance(i, Token)]
        if len(bases) > 1:
            raise Bad(name, "an enumeration with two types of its values")
        values = tuple(i for i in rest if isinstance(i, tuple) and i[0] != "initial")
        return t.EnumDecl(self._pos(name), str(name), values, initial_of(rest), bases[0] if bases else None)

    def enum_type(self, meta: Meta, items: list[Any]) -> t.EnumType:
        values = tuple(i for i in items if isinstance(i, tuple))
        bases = [t.NamedType(self._pos(i), str(i)) for i in items if isinstance(i, Token)]
        return t.EnumType(self._pos(meta), values, bases[0] if bases else None)

    def enum_value(self, meta: Meta, items: list[Any]) -> tuple[str, int | t.Expr | None]:
        stated = items[1] if len(items) > 1 else None
        return str(items[0]), stated if stated is None else _number_or_expression(stated)

    def alias_decl(self, meta: Meta, items: list[Any]) -> t.AliasDecl:
        return t.AliasDecl(self._pos(items[0]), str(items[0]), spec_of(items), initial_of(items))

    def named_type(self, meta: Meta, items: list[Any]) -> t.NamedType:
        return t.NamedType(self._pos(meta), ".".join(items))

    def created_type(self, meta: Meta, items: list[Any]) -> t.NamedType:
        names = [item for item in items if isinstance(item, Token)]
        return t.NamedType(self._pos(meta), ".".join(names), tuple(items[len(names) :]))

    def created(self, meta: Meta, items: list[Any]) -> tuple[t.Argument, ...]:
        return tuple(items)

    def subrange_type(self, meta: Meta, items: list[Any]) -> t.SubrangeType:
        return t.SubrangeType(self._pos(meta), str(items[0]), items[1], items[2])

    def string_type(self, meta: Meta, items: list[Any]) -> t.StringType:
        return t.StringType(self._pos(meta), items[0].upper() == "WSTRING", items[1] if len(items) > 1 else None)

    def messages_type(self, meta: Meta, items: list[Any]) -> t.MessagesType:
        sizes = [*items[1:], None, None]
        return t.MessagesType(self._pos(meta), sizes[0], sizes[1])

    def array_type(self, meta: Meta, items: list[Any]) -> t.ArrayType:
        ranges = tuple(item for item in items[:-1] if item is not None)
        if ranges and len(ranges) < len(items) - 1:
            raise Bad(
                Token("ARRAY", "*", line=meta.line, column=meta.column), "an array with limits in some dimensions only"
            )
        return t.ArrayType(self._pos(meta), ranges, items[-1], 0 if ranges else len(items) - 1)

    def pointer_type(self, meta: Meta, items: list[Any]) -> t.PointerType:
        return t.PointerType(self._pos(meta), items[0].upper(), items[1])

    def range(self, meta: Meta, items: list[Any]) -> tuple[t.Expr, t.Expr]:
        return items[0], items[1]

    def open_range(self, meta: Meta, items: list[Any]) -> None:
        return None

    def bound(self, meta: Meta, items: list[Any]) -> t.Expr:
        return items[0]  # type: ignore[no-any-return]

    def init_expression(self, meta: Meta, items: list[Any]) -> t.Expr:
        return items[0]  # type: ignore[no-any-return]

    def init_array(self, meta: Meta, items: list[Any]) -> t.InitArray:
        return t.InitArray(self._pos(meta), tuple(items))

    def unbracketed(self, meta: Meta, items: list[Any]) -> tuple[str, t.Init]:
        return "initial", t.InitArray(self._pos(meta), tuple(items), bracketed=False)

    def one_item(self, meta: Meta, items: list[Any]) -> tuple[int, t.Init]:
        return 1, items[0]

    def repeated_item(self, meta: Meta, items: list[Any]) -> tuple[int, t.Init | None]:
        return integer(items[0]), items[1] if len(items) > 1 else None

    def init_struct(self, meta: Meta, items: list[Any]) -> t.InitStruct:
        return t.InitStruct(self._pos(meta), tuple(items))

    def member_init(self, meta: Meta, items: list[Any]) -> tuple[str, t.Init]:
        return str(items[0]), items[1]


def spec_of(items: list[Any]) -> t.TypeSpec:
    return next(i for i in items if isinstance(i, t.TypeSpec))


def _number_or_expression(expr: t.Expr) -> int | t.Expr:
    """Return the number of an integer literal with or without a sign, and any other expression, which needs the compiler."""
    sign, literal = (expr.op, expr.operand) if isinstance(expr, t.Unary) else ("", expr)
    if not (isinstance(literal, t.Literal) and literal.kind in ("INTEGER", "BASED")):
        return expr
    number = integer(Token(literal.kind, literal.text, line=literal.pos.line, column=literal.pos.column))
    return -number if sign == "-" else number if sign in ("", "+") else expr


def initial_of(items: list[Any]) -> t.Init | None:
    return next((i[1] for i in items if isinstance(i, tuple) and i[0] == "initial"), None)
