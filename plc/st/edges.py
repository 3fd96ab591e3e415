"""Inputs that detect an edge: ``VAR_INPUT start : BOOL R_EDGE; END_VAR`` (IEC 61131-3:2013, 6.6.3).

Such an input stands for the output Q of an R_TRIG or F_TRIG that is called with the input each time the POU is called. The
translation declares this block and reads its Q in place of the input. The name of the block begins with 0, so no source
can contain it.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from fieldtwin.gateway.core.files.error_collector import ErrorCollector
from fieldtwin.plc.st.syntax import tree as t
from fieldtwin.plc.st.syntax.errors import invalid
from fieldtwin.plc.st.syntax.walk import with_parts

_BLOCKS = {"R_EDGE": "R_TRIG", "F_EDGE": "F_TRIG"}


def without_edges(unit: t.SourceUnit) -> t.SourceUnit:
    """Return `unit` with the edges of inputs as function blocks. Its charts must have been translated before.

    Raises `FileInvalid` with line and column for the first edge in a wrong place, and with the others.
    """
    errors = ErrorCollector()
    pous = tuple(_without_edges(pou, errors) for pou in unit.pous)
    for variable in (v for block in unit.globals for v in block.variables):
        _check(variable, "VAR_GLOBAL", errors)
    errors.raise_all()
    return replace(unit, pous=pous)


def _without_edges(pou: t.Pou, errors: ErrorCollector) -> t.Pou:
    edges: dict[str, t.VarDecl] = {}
    for block in pou.blocks:
        place = f"a {pou.kind}, which keeps no values" if pou.kind in ("FUNCTION", *t.METHODS) else block.kind
        for variable in block.variables:
            _check(variable, place, errors)
            if variable.edge:
                edges[variable.name.lower()] = variable
    methods = tuple(_without_edges(method, errors) for method in pou.methods)
    if not edges:
        return pou
    declared = [t.VarDecl(v.pos, _trigger(v.name), t.NamedType(v.pos, _BLOCKS[v.edge]), None) for v in edges.values()]
    calls = tuple(_called(v) for v in edges.values())
    return replace(
        pou,
        blocks=(*pou.blocks, t.VarBlock(pou.pos, "VAR", frozenset(), tuple(declared))),
        body=(*calls, *_reading(pou.body, edges)),
        actions=tuple(replace(action, body=_reading(action.body, edges)) for action in pou.actions),
        methods=tuple(replace(method, body=_reading(method.body, edges)) for method in methods),
    )


def _check(variable: t.VarDecl, place: str, errors: ErrorCollector) -> None:
    """Add an error for an edge that is not at a BOOL in VAR_INPUT of a PROGRAM or FUNCTION_BLOCK."""
    kind = variable.type
    is_bool = isinstance(kind, t.NamedType) and kind.name.upper() == "BOOL"
    if variable.edge and not (is_bool and place == "VAR_INPUT"):
        expected = "a BOOL in VAR_INPUT of a PROGRAM or FUNCTION_BLOCK"
        got = place if is_bool else "another type"
        errors.add(invalid(variable.pos, f"{variable.edge} of {variable.name}", expected, got))


def _trigger(name: str) -> str:
    return f"0edge_{name.lower()}"


def _called(variable: t.VarDecl) -> t.CallStatement:
    pos = variable.pos
    argument = t.Argument(pos, "CLK", t.Ref(pos, variable.name))
    return t.CallStatement(pos, t.Call(pos, t.Ref(pos, _trigger(variable.name)), (argument,)))


def _reading(node: Any, edges: dict[str, t.VarDecl]) -> Any:
    """Return a part of the tree that reads Q of the block in place of an input. Targets of assignments are not replaced."""
    if isinstance(node, t.Ref) and node.name.lower().removesuffix("^") == "this" and node.selectors:
        first, *others = node.selectors
        if isinstance(first, t.Member) and first.name.lower() in edges:
            members = (t.Member(first.pos, _trigger(first.name)), t.Member(first.pos, "Q"))
            return t.Ref(node.pos, node.name, (*members, *_reading(tuple(others), edges)))
    if isinstance(node, t.Ref) and node.name.lower() in edges:
        return t.Ref(node.pos, _trigger(node.name), (t.Member(node.pos, "Q"), *_reading(node.selectors, edges)))
    return with_parts(node, lambda part: _reading(part, edges), but="target")
