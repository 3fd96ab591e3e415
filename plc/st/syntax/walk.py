"""Walks through a tree."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields, is_dataclass
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
