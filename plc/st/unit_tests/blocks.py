"""PROGRAMs as function blocks, so that a test can declare, call and read them like any other block.

In a test a program has no process image. So its inputs are set by the test, and IS_GOOD(x) reads the additional input
``x_IS_GOOD``, which is TRUE at first. Its local variables can be read, as outputs are, and so can those of function blocks
and the steps of charts.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from fieldtwin.plc.st.classes.readable import READABLE, readable
from fieldtwin.plc.st.compiler.configurations.called import AS_BLOCK
from fieldtwin.plc.st.compiler.configurations.located import KINDS
from fieldtwin.plc.st.syntax import tree as t
from fieldtwin.plc.st.syntax.addresses import area_of
from fieldtwin.plc.st.syntax.walk import nodes, with_parts


def programs_as_blocks(unit: t.SourceUnit) -> t.SourceUnit:
    """Return `unit` with a function block in place of each PROGRAM. One with MESSAGES, which a test cannot call, is missing."""
    missing = {
        pou.name: reason for pou in unit.pous if pou.kind == "PROGRAM" and (reason := _no_block(pou)) is not None
    }
    pous = (pou for pou in unit.pous if pou.name not in missing)
    return replace(
        unit,
        pous=tuple(_block(pou) if pou.kind == "PROGRAM" else readable(pou) for pou in pous),
        instances=(),
        missing=(*unit.missing, *missing.values()),
    )


def _no_block(program: t.Pou) -> t.Missing | None:
    """Return why a program cannot be a block; None if it can."""
    for v in (v for block in program.blocks for v in block.variables):
        if isinstance(v.type, t.MessagesType):
            reason = f"a test cannot call program {program.name}, whose variable {v.name} is MESSAGES"
            return t.Missing(v.pos, "program", program.name, reason)
    return None


def _block(program: t.Pou) -> t.Pou:
    inputs = {v.name.lower(): v for b in program.blocks if b.kind == "VAR_INPUT" for v in b.variables}
    bodies = (program.body, program.actions, program.methods)
    asked = [name for name in inputs if any(_asks(node, name) for node in nodes(bodies))]
    blocks = [_visible(part) for block in program.blocks for part in _unlocated(block)]
    if asked:
        blocks.append(
            t.VarBlock(program.pos, "VAR_INPUT", frozenset(), tuple(_quality(inputs[name]) for name in asked))
        )
    changed: t.Pou = _reading(program, set(asked))
    modifiers = changed.modifiers | {AS_BLOCK, READABLE}
    return replace(changed, kind="FUNCTION_BLOCK", blocks=tuple(blocks), modifiers=modifiers)


def _unlocated(block: t.VarBlock) -> list[t.VarBlock]:
    """Return a block with each variable that has an address in a separate block: %I as an input, %Q as an output."""
    if not any(v.location for v in block.variables):
        return [block]
    return [
        replace(
            block, kind=KINDS[area_of(v.location)] if v.location else block.kind, variables=(replace(v, location=""),)
        )
        for v in block.variables
    ]


def _visible(block: t.VarBlock) -> t.VarBlock:
    """Return a block without RETAIN, because a test begins with initial values, and local variables as outputs."""
    kind = "VAR_OUTPUT" if block.kind == "VAR" and "CONSTANT" not in block.qualifiers else block.kind
    return replace(block, kind=kind, qualifiers=block.qualifiers - {"RETAIN", "NON_RETAIN", "PERSISTENT"})


def _quality(variable: t.VarDecl) -> t.VarDecl:
    pos = variable.pos
    return t.VarDecl(pos, _quality_name(variable.name), t.NamedType(pos, "BOOL"), t.Literal(pos, "TRUE", "TRUE"))


def _quality_name(name: str) -> str:
    return f"{name}_IS_GOOD"


def _asks(node: Any, name: str) -> bool:
    """Return whether a node is the call of IS_GOOD for the input `name`."""
    if not (isinstance(node, t.Call) and node.ref.name.upper() == "IS_GOOD" and len(node.arguments) == 1):
        return False
    value = node.arguments[0].value
    return isinstance(value, t.Ref) and not value.selectors and value.name.lower() == name


def _reading(node: Any, asked: set[str]) -> Any:
    """Return a part of the tree that reads the additional inputs in place of each IS_GOOD."""
    for name in asked:
        if _asks(node, name):
            return t.Ref(node.pos, _quality_name(node.arguments[0].value.name))
    return with_parts(node, lambda part: _reading(part, asked))
