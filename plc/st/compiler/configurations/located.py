"""Directly represented variables (IEC 61131-3, 6.5.5: ``VAR lamp AT %QX0.0 : BOOL;``, ``%QX0.0 := TRUE;``) as inputs and outputs.

OpenPLC and other systems bind a program to its hardware by addresses; here the system file binds it, by name. So a
variable at %I is an input, at %Q an output, at %M an ordinary variable.

An address that one PROGRAM alone uses is a variable of that program. Any other address is a global variable, which each program
that uses it, directly or through function blocks and functions, offers as its input or output. All declarations of one address
are then this one variable, as in OpenPLC. A global variable that only an address names has the address as its name.

A variable of a function block at a full address is the global variable of this address in every instance. A variable at ``%I*``,
``%Q*`` or ``%M*`` of a function block or structure belongs to its instance (`parts`).

Addresses of different sizes, such as %QX0.0 and %QW0, are different variables. The standard leaves the correspondence between
an address and its place to the manufacturer; OpenPLC has one area for each size.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

from fieldtwin.plc.st.syntax import tree as t
from fieldtwin.plc.st.syntax.addresses import address_of, area_of, bits_of
from fieldtwin.plc.st.syntax.walk import nodes

KINDS = {"I": "VAR_INPUT", "Q": "VAR_OUTPUT", "M": "VAR"}
RETAIN = frozenset({"RETAIN", "PERSISTENT"})
_BLOCKS = {
    "PROGRAM": ("VAR", "VAR_INPUT", "VAR_OUTPUT"),
    "FUNCTION_BLOCK": ("VAR", "VAR_INPUT", "VAR_OUTPUT"),
    "CLASS": ("VAR",),
}
"""The blocks of each kind of POU whose variables can have addresses."""
_TYPES = {"X": "BOOL", "B": "BYTE", "W": "WORD", "D": "DWORD", "L": "LWORD"}
"""The type of a variable that is not declared, by the size in its address (IEC 61131-3:2013, table 16)."""


def misplaced(unit: t.SourceUnit) -> Iterator[tuple[t.Pos, str, str]]:
    """Yield each address that is not allowed where it stands: its place, the error, and what is expected there."""
    for pou in unit.pous:
        for part in (pou, *pou.methods):
            for block in part.blocks:
                for v in located_in([block]):
                    where = f"{v.name} AT {v.location}: an address in {block.kind} of a {part.kind}"
                    if block.kind not in _BLOCKS.get(part.kind, ()):
                        expected = "VAR, VAR_INPUT or VAR_OUTPUT of a PROGRAM or FUNCTION_BLOCK, or VAR_GLOBAL"
                        yield v.pos, where, f"addresses in {expected}"
                    elif part.kind != "PROGRAM" and block.kind != "VAR" and address_of(v.location):
                        free = f"{v.location[:2]}*"
                        yield v.pos, where, f"{free}, because each instance has its own {v.name}, or the address in VAR"
    for declared in unit.types:
        for v in declared.fields if isinstance(declared, t.StructDecl) else ():
            if address_of(v.location):
                where = f"{v.name} AT {v.location}: an address in the structure {declared.name}"
                yield v.pos, where, f"{v.location[:2]}*, because each variable of this type has its own {v.name}"


def shared_addresses(blocks: Iterable[t.VarBlock]) -> Iterator[tuple[t.VarDecl, t.VarDecl]]:
    """Return the outputs and %M variables in `blocks` whose address an earlier variable has, with that variable."""
    first: dict[str, t.VarDecl] = {}
    for variable in (v for block in blocks for v in block.variables):
        address = address_of(variable.location)
        if address and area_of(address) != "I" and (other := first.setdefault(address, variable)) is not variable:
            yield variable, other


def without_addresses(unit: t.SourceUnit) -> t.SourceUnit:
    """Return `unit` with the located variables of its programs in the blocks where they belong, in their order.

    A variable whose address is used elsewhere becomes a VAR_EXTERNAL that keeps its location. The address is then a global
    variable, which is declared here if no VAR_GLOBAL has it.
    """
    uses = _uses(unit)
    shared = {address for address, places in uses.items() if len(places) > 1 or not places[0]}
    declared = set(addresses_in(unit.globals))
    programs = [pou for pou in unit.pous if pou.kind == "PROGRAM"]
    others = [pou for pou in unit.pous if pou.kind in _BLOCKS and pou.kind != "PROGRAM"]
    stated = {
        address_of(v.location): (v, block.qualifiers & RETAIN)
        for pou in (*reversed(others), *reversed(programs))
        for block in pou.blocks
        for v in located_in([block])
    }
    local = set(addresses_in(block for pou in programs for block in pou.blocks))
    added = []
    for address in uses:
        if address in shared | (uses.keys() - local) and address not in declared:
            v, qualifiers = stated.get(address) or (_undeclared(unit, address), frozenset())
            variable = replace(v, name=address, location=address)
            added.append(t.VarBlock(v.pos, "VAR_GLOBAL", qualifiers, (variable,)))
    known = frozenset(declared | {block.variables[0].name for block in added})
    pous = tuple(_program(pou, known) if pou.kind == "PROGRAM" else pou for pou in unit.pous)
    return replace(unit, globals=(*unit.globals, *added), pous=pous)


def _uses(unit: t.SourceUnit) -> dict[str, list[str]]:
    """Return the addresses that a unit uses, each with the POUs that use it; "" stands for VAR_GLOBAL."""
    found: dict[str, list[str]] = {}
    places = [("", address) for address in addresses_in(unit.globals)]
    for pou in unit.pous:
        names = [*addresses_in(pou.blocks)] if pou.kind in _BLOCKS else []
        names += [node.name for node in nodes(pou) if isinstance(node, t.Ref) and node.name.startswith("%")]
        several = [one for one in unit.instances if one.program.lower() == pou.name.lower()][1:]
        places += [(pou.name.lower(), name) for name in names]
        places += [(f"{pou.name.lower()}{number}", name) for number in range(len(several)) for name in names]
    places += [
        ("", ref.name) for ref in nodes(connections(unit)) if isinstance(ref, t.Ref) and ref.name.startswith("%")
    ]
    for place, address in places:
        if place not in found.setdefault(address, []):
            found[address].append(place)
    return found


def used_addresses(unit: t.SourceUnit) -> frozenset[str]:
    """Return the addresses that a unit uses, in their normal form."""
    return frozenset(_uses(unit)) | frozenset(addresses_in(block for pou in unit.pous for block in pou.blocks))


def overlaps(unit: t.SourceUnit, *, in_bytes: bool) -> Iterator[tuple[t.Pos, str, str]]:
    """Yield each address at %Q or %M that shares bits with an earlier one of a different size in systems where the sizes overlap.

    The items are the place, the address, and the earlier address (`fieldtwin.plc.st.syntax.addresses.bits_of`).
    """
    places = [
        (address_of(v.location), v.pos) for v in located_in((*unit.globals, *(b for p in unit.pous for b in p.blocks)))
    ]
    refs = (node for node in nodes((unit.pous, connections(unit))) if isinstance(node, t.Ref))
    direct = sorted(
        ((ref.name, ref.pos) for ref in refs if ref.name.startswith("%")),
        key=lambda one: (one[1].path, one[1].line, one[1].column),
    )
    first: dict[tuple[str, int], str] = {}
    seen: set[str] = {""}
    for address, pos in (*places, *direct):
        if address in seen or area_of(address) == "I":
            continue
        seen.add(address)
        bits = [(area_of(address), bit) for bit in bits_of(address, in_bytes=in_bytes)]
        other = next((first[bit] for bit in bits if bit in first), "")
        if other:
            yield pos, address, other
        for bit in bits:
            first.setdefault(bit, address)


def connections(unit: t.SourceUnit, program: str = "") -> tuple[t.Argument, ...]:
    """Return what configurations connect with variables of programs, or of the PROGRAM `program`, in lower case."""
    return tuple(
        argument
        for instance in unit.instances
        if program in ("", instance.program.lower())
        for argument in instance.arguments
    )


def addresses_in(blocks: Iterable[t.VarBlock]) -> Iterator[str]:
    """Return the full addresses of the variables in `blocks`, in their normal form."""
    return (address for v in located_in(blocks) if (address := address_of(v.location)))


def located_in(blocks: Iterable[t.VarBlock]) -> Iterator[t.VarDecl]:
    """Return the variables in `blocks` that have an address, also one without a number."""
    return (v for block in blocks for v in block.variables if v.location)


def _undeclared(unit: t.SourceUnit, address: str) -> t.VarDecl:
    """Return the declaration of an address that has none, at its first use."""
    everything = nodes((unit.pous, connections(unit)))
    uses = (node for node in everything if isinstance(node, t.Ref) and node.name == address)
    pos = min((use.pos for use in uses), key=lambda pos: (pos.line, pos.column))
    return t.VarDecl(pos, address, t.NamedType(pos, _TYPES[address[2]]), None, address)


def _program(pou: t.Pou, known: frozenset[str]) -> t.Pou:
    blocks: list[t.VarBlock] = []
    for block in pou.blocks:
        if block.kind not in _BLOCKS["PROGRAM"] or not any(v.location for v in block.variables):
            blocks.append(block)
            continue
        for v in block.variables:
            kind = KINDS[area_of(v.location)] if v.location else block.kind
            if address_of(v.location) in known:
                kind = "VAR_EXTERNAL"
            if blocks and (blocks[-1].pos, blocks[-1].kind) == (block.pos, kind):
                blocks[-1] = replace(blocks[-1], variables=(*blocks[-1].variables, v))
            else:
                blocks.append(t.VarBlock(block.pos, kind, block.qualifiers, (v,)))
    return replace(pou, blocks=tuple(blocks))
