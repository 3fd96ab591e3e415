"""The rules of the grammar for the declarations of a file: POUs, configurations."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any

from lark import Token, v_args
from lark.tree import Meta

from fieldtwin.plc.st.syntax import tree as t
from fieldtwin.plc.st.syntax.rules.base import Bad, Bases, Rules
from fieldtwin.plc.st.syntax.rules.charts import chart_of
from fieldtwin.plc.st.syntax.rules.declarations import initial_of, spec_of
from fieldtwin.plc.st.syntax.written import text_of

_OF_ALL_INTERFACES = "__system.iqueryinterface"
"""The interface that others extend in CODESYS to be queried, in lower case. Here all interfaces can be queried."""


@dataclass(frozen=True, slots=True)
class _Members:
    """A method or a property: its methods, and the token of its name."""

    token: Token
    methods: tuple[t.Pou, ...]


def _flat(items: Iterable[Any]) -> Iterator[Any]:
    """Yield the items, and in place of a tuple its items."""
    for item in items:
        yield from item if isinstance(item, tuple) else (item,)


@dataclass(frozen=True, slots=True)
class _InTask:
    """The name of the task in which a program of a configuration runs."""

    name: Token


Configured = t.VarBlock | t.Instance | t.Task | t.ConfiguredVariable
"""A part of a configuration that is used."""


def _is_number(expr: t.Expr) -> bool:
    """Return whether an expression is a decimal number, which may have a sign."""
    operand = expr.operand if isinstance(expr, t.Unary) and expr.op == "-" else expr
    return isinstance(operand, t.Literal) and operand.kind == "INTEGER"


def _token(meta: Meta) -> Token:
    return Token("NAME", "", line=meta.line, column=meta.column)


@v_args(meta=True)
class UnitRules(Rules):
    """The methods of the transformer for the declarations of a file: POUs, configurations."""

    def start(self, meta: Meta, items: list[Any]) -> t.SourceUnit:
        unit = self._unit(items)
        using = tuple(name for item in items if isinstance(item, Bases) for name in item.names)
        return placed(unit, "", using) if using else unit

    def namespace(self, meta: Meta, items: list[Any]) -> t.SourceUnit:
        name = next(i for i in items if isinstance(i, t.NamedType))
        using = tuple(name for item in items if isinstance(item, Bases) for name in item.names)
        return placed(self._unit(items), name.name, using)

    def using(self, meta: Meta, items: list[Any]) -> Bases:
        return Bases("USING", tuple(items[1:]))

    def _unit(self, items: list[Any]) -> t.SourceUnit:
        inner = [i for i in items if isinstance(i, t.SourceUnit)]
        types = tuple(one for item in items if isinstance(item, list) for one in item)
        return t.SourceUnit(
            (*types, *(one for unit in inner for one in unit.types)),
            (
                *(each for each in _flat(items) if isinstance(each, t.VarBlock)),
                *(block for unit in inner for block in unit.globals),
            ),
            (*_with_members(items), *(one for unit in inner for one in unit.pous)),
            instances=tuple(each for each in _flat(items) if isinstance(each, t.Instance)),
            tests=tuple(i for i in items if isinstance(i, t.Test)),
            tasks=tuple(each for each in _flat(items) if isinstance(each, t.Task)),
            configured=tuple(each for each in _flat(items) if isinstance(each, t.ConfiguredVariable)),
        )

    def test(self, meta: Meta, items: list[Any]) -> t.Test:
        word, name, *blocks, body = items
        return t.Test(self._pos(word), str(name)[1:-1].replace("$'", "'"), tuple(blocks), body)

    def configuration(self, meta: Meta, items: list[Any]) -> tuple[Configured, ...]:
        """Return the globals, tasks and programs of a configuration, with those of its resources."""
        return self._configured("", items)

    def resource(self, meta: Meta, items: list[Any]) -> tuple[Configured, ...]:
        return self._configured(str(items[0]), items)

    def _configured(self, resource: str, items: list[Any]) -> tuple[Configured, ...]:
        found: list[Configured] = []
        tasks = {item.name.lower() for item in items if isinstance(item, t.Task)}
        for item in items:
            if isinstance(item, t.Instance) and isinstance(item.task, Token) and item.task.lower() not in tasks:
                raise Bad(item.task, f"a task {str(item.task)!r} is not declared in this configuration or resource")
            if isinstance(item, t.Instance):
                found.append(replace(item, task=str(item.task), resource=resource))
            elif isinstance(item, t.Task):
                found.append(replace(item, resource=resource))
            elif isinstance(item, t.VarBlock):
                found.append(item)
            elif isinstance(item, tuple):
                found += item
        return tuple(found)

    def task(self, meta: Meta, items: list[Any]) -> t.Task:
        name, *values = items
        return t.Task(self._pos(name), str(name), tuple(values))

    def task_value(self, meta: Meta, items: list[Any]) -> tuple[str, t.Expr]:
        name, value = items
        if name.upper() not in ("INTERVAL", "PRIORITY", "SINGLE"):
            raise Bad(name, "not a property of a task, which are INTERVAL, PRIORITY and SINGLE")
        return name.upper(), value

    def instance(self, meta: Meta, items: list[Any]) -> t.Instance:
        parts: list[Any] = [item for item in items if isinstance(item, Token) or not isinstance(item, str)]
        name, *rest = parts
        task = rest.pop(0).name if isinstance(rest[0], _InTask) else ""
        program, *arguments = rest
        return t.Instance(self._pos(program), str(name), str(program), task, tuple(arguments))

    def in_task(self, meta: Meta, items: list[Any]) -> _InTask:
        return _InTask(items[0])

    def connected(self, meta: Meta, items: list[Any]) -> t.Argument:
        (argument,) = items
        if not argument.name:
            raise Bad(_token(meta), "an argument of a program without the name of a variable")
        return argument  # type: ignore[no-any-return]

    def block_in_task(self, meta: Meta, items: list[Any]) -> t.Argument:
        raise Bad(items[0], "a task for a function block is not supported; put it into a program with this task")

    def config_vars(self, meta: Meta, items: list[Any]) -> tuple[t.ConfiguredVariable, ...]:
        return tuple(items)

    def config_var(self, meta: Meta, items: list[Any]) -> t.ConfiguredVariable:
        ref = items[0]
        path = [ref.name]
        for selector in ref.selectors:
            if isinstance(selector, t.Member):
                path.append(selector.name)
            elif isinstance(selector, t.Index) and all(_is_number(one) for one in selector.indices):
                path[-1] += f"[{','.join(text_of(one) for one in selector.indices)}]"
            else:
                raise Bad(_token(meta), "not a path such as Resource.Instance.Variable")
        location = next((i[1] for i in items if isinstance(i, tuple) and i[0] == "at"), "")
        return t.ConfiguredVariable(self._pos(meta), tuple(path), location, spec_of(items), initial_of(items))

    def access_vars(self, meta: Meta, items: list[Any]) -> None:
        return None

    def access(self, meta: Meta, items: list[Any]) -> None:
        return None

    # -- POUs and classes -------------------------------------------------------------------------------------------------

    def _pou(self, kind: str, items: list[Any]) -> t.Pou:
        modifiers = frozenset(_take(items, "MODIFIER"))
        name, *rest = items
        returns = next((i for i in rest if isinstance(i, t.TypeSpec)), None)
        blocks = tuple(i for i in rest if isinstance(i, t.VarBlock))
        parts = rest[-1] if rest and isinstance(rest[-1], tuple) else rest
        body = tuple(i for i in parts if isinstance(i, t.Statement))
        actions = tuple(i for i in parts if isinstance(i, t.Action))
        methods = _methods(parts)
        bases = {i.word: i.names for i in rest if isinstance(i, Bases)}
        using = tuple(name for i in rest if isinstance(i, Bases) and i.word == "USING" for name in i.names)
        return t.Pou(
            self._pos(name), kind, str(name), returns, blocks, body, actions, chart_of(parts), methods,
            bases.get("EXTENDS", ()), bases.get("IMPLEMENTS", ()), modifiers, t.Within("", using),
        )  # fmt: skip

    def program(self, meta: Meta, items: list[Any]) -> t.Pou:
        return self._pou("PROGRAM", items)

    def function(self, meta: Meta, items: list[Any]) -> t.Pou:
        return self._pou("FUNCTION", items)

    def function_block(self, meta: Meta, items: list[Any]) -> t.Pou:
        return self._pou("FUNCTION_BLOCK", items)

    def class_(self, meta: Meta, items: list[Any]) -> t.Pou:
        return self._pou("CLASS", items)

    def interface(self, meta: Meta, items: list[Any]) -> t.Pou:
        return self._pou("INTERFACE", items)

    def pou_name(self, meta: Meta, items: list[Any]) -> t.NamedType:
        return t.NamedType(self._pos(meta), ".".join(items))

    def extends(self, meta: Meta, items: list[Any]) -> Bases:
        return Bases("EXTENDS", tuple(item for item in items if item.name.lower() != _OF_ALL_INTERFACES))

    def implements(self, meta: Meta, items: list[Any]) -> Bases:
        return Bases("IMPLEMENTS", tuple(items))

    def method(self, meta: Meta, items: list[Any]) -> _Members:
        pou = self._pou("METHOD", items[1:])
        return _Members(next(i for i in items[1:] if i.type == "NAME"), (pou,))

    def property(self, meta: Meta, items: list[Any]) -> _Members:
        """Return GET and SET of a property as methods: GET returns the value, and SET has it as its input."""
        _, *items = items
        modifiers = frozenset(_take(items, "MODIFIER"))
        name, kind, *accessors = items
        methods = []
        for accessor in accessors:
            word, own, blocks, body = accessor
            if word == "SET":
                value = t.VarDecl(self._pos(name), str(name), kind, None)
                blocks = (t.VarBlock(self._pos(name), "VAR_INPUT", frozenset(), (value,)), *blocks)
            returns = kind if word == "GET" else None
            method = t.Pou(self._pos(name), word, str(name), returns, blocks, body, modifiers=modifiers | own)
            methods.append(method)
        if not methods:
            raise Bad(name, f"property {name} has neither GET nor SET")
        return _Members(name, tuple(methods))

    def accessor(self, meta: Meta, items: list[Any]) -> _Accessor:
        word, *items = items
        own = frozenset(_take(items, "MODIFIER"))
        return str(word).upper(), own, tuple(items[:-1]), items[-1]


_Accessor = tuple[str, frozenset[str], tuple[t.VarBlock, ...], tuple[t.Statement, ...]]
"""GET or SET, the modifiers, the variables, and the statements of one."""


def placed(unit: t.SourceUnit, namespace: str, using: tuple[t.NamedType, ...]) -> t.SourceUnit:
    """Return `unit` with its declarations in a namespace, or in one below it, and with the names after its USING."""

    def of(one: Any) -> Any:
        parts = [part for part in (namespace, one.within.namespace) if part]
        return replace(one, within=t.Within(".".join(parts), (*one.within.using, *using)))

    def of_block(block: t.VarBlock) -> t.VarBlock:
        full = ".".join(part for part in (namespace, block.namespace) if part)
        return replace(block, namespace=full, list=full, only_qualified=True) if full else block

    return replace(
        unit,
        types=tuple(map(of, unit.types)),
        globals=tuple(map(of_block, unit.globals)),
        pous=tuple(map(of, unit.pous)),
        tests=tuple(map(of, unit.tests)),
    )


def _take(items: list[Any], kind: str) -> list[str]:
    """Remove the tokens of this kind from `items`, and return them in capitals."""
    found = [i for i in items if isinstance(i, Token) and i.type == kind]
    items[:] = [i for i in items if not (isinstance(i, Token) and i.type == kind)]
    return [i.upper() for i in found]


def _methods(parts: Iterable[Any]) -> tuple[t.Pou, ...]:
    return tuple(method for i in parts if isinstance(i, _Members) for method in i.methods)


def _with_members(items: Iterable[Any]) -> list[t.Pou]:
    """Return the POUs of a file. A method after the end of a POU belongs to it."""
    pous: list[t.Pou] = []
    for item in items:
        if isinstance(item, t.Pou):
            pous.append(item)
        elif isinstance(item, _Members):
            if not pous or pous[-1].kind == "FUNCTION":
                raise Bad(
                    item.token, f"{item.token} is a method or property that belongs to no FUNCTION_BLOCK or CLASS"
                )
            pous[-1] = replace(pous[-1], methods=(*pous[-1].methods, *item.methods))
    return pous
