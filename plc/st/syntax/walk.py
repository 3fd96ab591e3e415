"""Walks through a tree, and changes of its parts."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import fields, is_dataclass, replace
from typing import Any

from fieldtwin.plc.st.syntax.tree import Pos


def nodes(root: Any) -> Iterator[Any]:
    """Yield `root`, if it is a node, and every node below it. A tuple counts as its items. The nodes come in no order."""
    stack = [root]
    while stack:
        node = stack.pop()
        if isinstance(node, tuple):
            stack.extend(node)
        elif is_dataclass(node) and not isinstance(node, Pos):
            yield node
            stack.extend(getattr(node, one.name) for one in fields(node))


def with_parts(node: Any, change: Callable[[Any], Any], but: str = "") -> Any:
    """Return a node or tuple with each of its parts as `change` returns it; the field `but` stays. Other values have no parts."""
    if isinstance(node, tuple):
        return tuple(change(part) for part in node)
    if is_dataclass(node) and not isinstance(node, type):
        return replace(node, **{one.name: change(getattr(node, one.name)) for one in fields(node) if one.name != but})
    return node
