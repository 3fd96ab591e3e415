"""Read a PLCopen XML export into the tree of Structured Text."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.plc.st.dialects import STANDARD, Dialect
from fieldtwin.plc.st.plcopen.convert import Export, convert
from fieldtwin.plc.st.plcopen.networks import Drawn
from fieldtwin.plc.st.syntax import tree as t
from fieldtwin.plc.st.syntax.parse import parse_all, parse_parts


def read_parts(
    text: str, path: str = "", dialect: Dialect = STANDARD
) -> Iterator[tuple[t.SourceUnit, tuple[str, ...], FileInvalid | None]]:
    """Read each declaration of an export alone, as `parse_parts` does."""
    export = convert(text, path)
    for unit, names, error in parse_parts(export.text, path, dialect):
        yield _complete(unit, export), names, error


def read_plcopen(text: str, path: str = "", dialect: Dialect = STANDARD) -> t.SourceUnit:
    """Return the declarations of an export. Raises `FileInvalid` for an error in a part of it that is supported."""
    export = convert(text, path)
    return _complete(parse_all(export.text, path, dialect), export)


def _complete(unit: t.SourceUnit, export: Export) -> t.SourceUnit:
    pous = tuple(_with_drawings(pou, export.drawings) for pou in unit.pous)
    return replace(unit, pous=pous, missing=export.missing)


def _with_drawings(pou: t.Pou, drawings: Mapping[tuple[str, str], Drawn]) -> t.Pou:
    """Return a POU with the statements of the bodies that are drawn."""

    def of(action: str) -> Drawn | None:
        return drawings.get((pou.name.lower(), action.lower()))

    found = [of(""), *(of(action.name) for action in pou.actions)]
    edges = tuple(edge for one in found if one is not None for edge in one.edges)
    block = (t.VarBlock(pou.pos, "VAR", frozenset(), edges),) if edges else ()
    actions = tuple(
        replace(action, body=one.body, chart=one.chart, graphic=one.graphic) if one is not None else action
        for action, one in zip(pou.actions, found[1:], strict=True)
    )
    body, chart = (found[0].body, found[0].chart) if found[0] is not None else (pou.body, pou.chart)
    graphic = found[0].graphic if found[0] is not None else None
    return replace(pou, blocks=(*pou.blocks, *block), body=body, actions=actions, chart=chart, graphic=graphic)
