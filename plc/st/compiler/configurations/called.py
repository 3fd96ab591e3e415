"""Calls of programs, an addition of CODESYS and TwinCAT to the standard: ``Pumps();`` executes the PROGRAM Pumps.

There, a PROGRAM is the only instance of itself, and every POU can call it and read its variables. So a program that others call
becomes a function block with one global instance of the same name. The system cannot run it as a program any more.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from fieldtwin.plc.st.dialects import Dialect
from fieldtwin.plc.st.syntax import tree as t
from fieldtwin.plc.st.syntax.addresses import address_of
from fieldtwin.plc.st.syntax.errors import invalid
from fieldtwin.plc.st.syntax.walk import nodes

AS_BLOCK = "PROGRAM"
"""The modifier of a FUNCTION_BLOCK that is a PROGRAM in the source, because a test calls it."""


def with_called_programs(unit: t.SourceUnit, dialect: Dialect) -> t.SourceUnit:
    """Return `unit` with a function block and its instance in place of each program that another POU calls.

    Raises `FileInvalid` for the use of a variable of a program that no POU calls, because it runs in its own task.
    """
    programs = {pou.name.lower(): pou for pou in unit.pous if pou.kind == "PROGRAM" or AS_BLOCK in pou.modifiers}
    if not (dialect.vendor and programs):
        return unit
    taken = {v.name.lower() for block in unit.globals for v in block.variables} | {b.list.lower() for b in unit.globals}
    called: dict[str, t.Pou] = {}
    read: list[t.Ref] = []
    for pou in unit.pous:
        for ref, is_call in _uses(pou, frozenset()):
            name = ref.name.lower()
            if name in programs and name not in taken and name != pou.name.lower():
                if is_call:
                    called[name] = programs[name]
                else:
                    read.append(ref)
    for ref in read:
        if ref.name.lower() not in called and programs[ref.name.lower()].kind == "PROGRAM":
            name = programs[ref.name.lower()].name
            expected = f"a global variable, or a call {name}(); of the program"
            raise invalid(ref.pos, f"a variable of {name}, a PROGRAM that no POU calls", expected)
    used = called | {ref.name.lower(): programs[ref.name.lower()] for ref in read}
    instances = tuple(t.VarDecl(pou.pos, pou.name, t.NamedType(pou.pos, pou.name), None) for pou in used.values())
    if not used:
        return unit
    pous = tuple(_block(pou) if pou.kind == "PROGRAM" and pou.name.lower() in used else pou for pou in unit.pous)
    block = t.VarBlock(instances[0].pos, "VAR_GLOBAL", frozenset(), instances)
    return replace(unit, pous=pous, globals=(*unit.globals, block))


def _uses(pou: t.Pou, outer: frozenset[str]) -> Iterator[tuple[t.Ref, bool]]:
    """Yield each name that a POU and its methods use and do not declare, and whether it is called.

    `outer` are the names that the owner of a method declares.
    """
    own = outer | {v.name.lower() for block in pou.blocks for v in block.variables}
    own |= {method.name.lower() for method in pou.methods} | {action.name.lower() for action in pou.actions}
    parts = tuple(nodes((pou.body, pou.actions, pou.chart, tuple(v.initial for b in pou.blocks for v in b.variables))))
    calls = {id(node.ref) for node in parts if isinstance(node, t.Call)}
    for node in parts:
        if isinstance(node, t.Ref) and node.name.lower() not in own and (id(node) in calls or node.selectors):
            yield node, id(node) in calls
    for method in pou.methods:
        yield from _uses(method, own)


def _block(program: t.Pou) -> t.Pou:
    """Return a program as a function block, whose local variables other POUs can read, except those with an address."""
    blocks: list[t.VarBlock] = []
    for block in program.blocks:
        located = tuple(v for v in block.variables if address_of(v.location))
        others = replace(block, variables=tuple(v for v in block.variables if v not in located))
        if block.kind == "VAR" and "CONSTANT" not in block.qualifiers:
            others = replace(others, kind="VAR_OUTPUT")
        blocks += [others, *([replace(block, kind="VAR", variables=located)] if located else [])]
    return replace(program, kind="FUNCTION_BLOCK", blocks=tuple(blocks))
