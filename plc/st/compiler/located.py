"""Directly represented variables of a PROGRAM (IEC 61131-3, 6.5.5: ``VAR lamp AT %QX0.0 : BOOL;``) as inputs and
outputs.

OpenPLC and other systems bind a program to its hardware by addresses; here the system file binds it, by name. So a
variable at %I is an input, at %Q an output, at %M an ordinary variable; the rest of the address is ignored. Two
outputs or two %M variables with one address would be one variable in those systems, so a program that has them is refused.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace

from fieldtwin.plc.st.syntax import tree as t

_KINDS = {"I": "VAR_INPUT", "Q": "VAR_OUTPUT", "M": "VAR"}


_ADDRESS = re.compile(r"%([QM])([XBWDL]?)(\d+(?:\.\d+)*)", re.IGNORECASE)


def shared_addresses(pou: t.Pou) -> Iterator[tuple[t.VarDecl, t.VarDecl]]:
    """Return the outputs and %M variables of a POU whose address an earlier variable has, with that variable."""
    first: dict[tuple[str, str, tuple[int, ...]], t.VarDecl] = {}
    for variable in (v for block in pou.blocks for v in block.variables):
        found = _ADDRESS.fullmatch(variable.location)
        if found is None:
            continue
        area, size, numbers = found.groups()
        address = (area.upper(), size.upper() or "X", tuple(int(number) for number in numbers.split(".")))
        if (other := first.setdefault(address, variable)) is not variable:
            yield variable, other


def without_addresses(unit: t.SourceUnit) -> t.SourceUnit:
    """Return `unit` with the located variables of its programs in the blocks where they belong, in their order."""
    return replace(unit, pous=tuple(_program(pou) if pou.kind == "PROGRAM" else pou for pou in unit.pous))


def _program(pou: t.Pou) -> t.Pou:
    blocks: list[t.VarBlock] = []
    for block in pou.blocks:
        if block.kind != "VAR" or not any(v.location for v in block.variables):
            blocks.append(block)
            continue
        for v in block.variables:
            kind = _KINDS.get(v.location[1:2].upper(), block.kind) if v.location else block.kind
            variable = replace(v, location="" if v.location[1:2].upper() in _KINDS else v.location)
            if blocks and (blocks[-1].pos, blocks[-1].kind) == (block.pos, kind):
                blocks[-1] = replace(blocks[-1], variables=(*blocks[-1].variables, variable))
            else:
                blocks.append(t.VarBlock(block.pos, kind, block.qualifiers, (variable,)))
    return replace(pou, blocks=tuple(blocks))
