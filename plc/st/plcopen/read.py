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
        yield _complete(unit, export, dialect), names, error


def read_plcopen(text: str, path: str = "", dialect: Dialect = STANDARD) -> t.SourceUnit:
    """Return the declarations of an export. Raises `FileInvalid` for an error in a part of it that is supported."""
    export = convert(text, path)
    return _complete(parse_all(export.text, path, dialect), export, dialect)


def _complete(unit: t.SourceUnit, export: Export, dialect: Dialect) -> t.SourceUnit:
    """Return a unit with the bodies that are drawn. Without unions and POUs with properties in dialects that do not have them."""
    missing = [] if dialect.vendor else list(_of_other_dialects(unit))
    left_out = {one.name for one in missing}
    pous = tuple(_with_drawings(pou, export.drawings) for pou in unit.pous if pou.name not in left_out)
    types = tuple(one for one in unit.types if one.name not in left_out)
    return replace(unit, types=types, pous=pous, missing=(*export.missing, *missing))


def _of_other_dialects(unit: t.SourceUnit) -> Iterator[t.Missing]:
    """Yield the declarations that only the dialects codesys and twincat have."""
    which = "which the dialects codesys and twincat have"
    for one in unit.types:
        if isinstance(one, t.StructDecl) and one.union:
            yield t.Missing(one.pos, "type", one.name, f"{one.name} is a UNION, {which}")
    reasons = {pou.name.lower(): f"{pou.name} has a property, {which}" for pou in unit.pous if _has_property(pou)}
    derived = [pou for pou in unit.pous if pou.extends]
    for _ in derived:
        for pou in derived:
            of = reasons.get(pou.extends[0].name.lower())
            if of is not None:
                reasons.setdefault(pou.name.lower(), f"{pou.name} extends {pou.extends[0].name}; {of}")
    for pou in unit.pous:
        if pou.name.lower() in reasons:
            kind = pou.kind.lower().replace("_", " ")
            yield t.Missing(pou.pos, kind, pou.name, reasons[pou.name.lower()])


def _has_property(pou: t.Pou) -> bool:
    return any(method.kind in ("GET", "SET") for method in pou.methods)


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
