"""The rules of the grammar for the declarations of a file: POUs, configurations."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

from lark import Token, v_args
from lark.tree import Meta

from fieldtwin.plc.st.syntax import tree as t
from fieldtwin.plc.st.syntax.rules.base import Bad, Rules
from fieldtwin.plc.st.syntax.rules.charts import chart_of


@dataclass(frozen=True, slots=True)
class _Task:
    """A TASK of a configuration or resource."""

    name: str


@dataclass(frozen=True, slots=True)
class _InTask:
    """A program of a configuration or resource, and the name of its task, if it states one."""

    instance: t.Instance
    task: Token | None


def _flat(items: Iterable[Any]) -> Iterator[Any]:
    """Yield the items, and in place of a tuple its items."""
    for item in items:
        yield from item if isinstance(item, tuple) else (item,)


@v_args(meta=True)
class UnitRules(Rules):
    """The methods of the transformer for the declarations of a file: POUs, configurations."""

    def start(self, meta: Meta, items: list[Any]) -> t.SourceUnit:
        types = tuple(one for item in items if isinstance(item, list) for one in item)
        return t.SourceUnit(
            types,
            tuple(each for each in _flat(items) if isinstance(each, t.VarBlock)),
            tuple(i for i in items if isinstance(i, t.Pou)),
            instances=tuple(each for each in _flat(items) if isinstance(each, t.Instance)),
            tests=tuple(i for i in items if isinstance(i, t.Test)),
        )

    def test(self, meta: Meta, items: list[Any]) -> t.Test:
        word, name, *blocks, body = items
        return t.Test(self._pos(word), str(name)[1:-1].replace("$'", "'"), tuple(blocks), body)

    def configuration(self, meta: Meta, items: list[Any]) -> tuple[t.VarBlock | t.Instance, ...]:
        """Return the globals and the programs of a configuration, with those of its resources."""
        tasks = {item.name.lower() for item in items if isinstance(item, _Task)}
        for item in items:
            if isinstance(item, _InTask) and item.task is not None and item.task.lower() not in tasks:
                raise Bad(item.task, f"a task {str(item.task)!r} is not declared in this configuration or resource")
        parts = [item.instance if isinstance(item, _InTask) else item for item in items]
        return tuple(each for each in _flat(parts) if isinstance(each, t.VarBlock | t.Instance))

    resource = configuration

    def task(self, meta: Meta, items: list[Any]) -> _Task:
        return _Task(str(items[0]))

    def task_value(self, meta: Meta, items: list[Any]) -> None:
        return None

    def instance(self, meta: Meta, items: list[Any]) -> _InTask:
        name, *task, program = items
        return _InTask(t.Instance(self._pos(program), str(name), str(program)), task[0] if task else None)

    def _pou(self, kind: str, meta: Meta, items: list[Any]) -> t.Pou:
        name, *rest = items
        returns = rest.pop(0) if isinstance(rest[0], t.TypeSpec) else None
        body = tuple(i for i in rest[-1] if not isinstance(i, t.Action | t.Step | t.Transition))
        actions = tuple(i for i in rest[-1] if isinstance(i, t.Action))
        return t.Pou(self._pos(name), kind, str(name), returns, tuple(rest[:-1]), body, actions, chart_of(rest[-1]))

    def program(self, meta: Meta, items: list[Any]) -> t.Pou:
        return self._pou("PROGRAM", meta, items)

    def function(self, meta: Meta, items: list[Any]) -> t.Pou:
        return self._pou("FUNCTION", meta, items)

    def function_block(self, meta: Meta, items: list[Any]) -> t.Pou:
        return self._pou("FUNCTION_BLOCK", meta, items)
