"""The lines of declarations at which a debugger should not stop by itself: those of initial values, and of the names of POUs."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from fieldtwin.plc.st.compiler.compile import CompiledUnit
from fieldtwin.plc.st.syntax import tree as t
from fieldtwin.plc.st.syntax.walk import nodes


def declaration_lines(units: Iterable[CompiledUnit]) -> dict[str, set[int]]:
    """Return, by file, the lines that name a POU, or declare variables or a result, and on which no statement begins."""
    found: dict[str, set[int]] = {}
    for pou in (pou for unit in units for pou in unit.source.pous):
        for pos in _declared(pou):
            found.setdefault(pos.path, set()).add(pos.line)
    for pou in (pou for unit in units for pou in unit.source.pous):
        bodies = (pou.body, *(one.body for one in pou.actions), *(one.body for one in pou.methods))
        for node in nodes(bodies):
            found.get(node.pos.path, set()).discard(node.pos.line)
    return found


def _declared(pou: t.Pou) -> Iterator[t.Pos]:
    yield pou.pos
    if pou.returns is not None:
        yield pou.returns.pos
    for v in (v for block in pou.blocks for v in block.variables):
        yield v.pos
        for node in nodes(v.initial):
            yield node.pos
    for method in pou.methods:
        yield from _declared(method)
