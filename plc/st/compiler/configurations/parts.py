"""The located parts of variables: members of function blocks and structures that are declared at ``%I*``, ``%Q*`` or ``%M*``.

Each instance has its own such variable (IEC 61131-3:2013, 6.5.6). A program offers it by its path, such as ``pump.fault``
or ``fans[2].run``, and VAR_CONFIG may give it an address. A structure or an array at an address is bound by its parts, too.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product

from fieldtwin.plc.st import types as ty
from fieldtwin.plc.st.compiler.declarations import Declarations
from fieldtwin.plc.st.runtime.parts import Key
from fieldtwin.plc.st.syntax import tree as t
from fieldtwin.plc.st.syntax.addresses import address_of

MAX_PARTS = 10_000
"""The largest number of located parts that a program offers."""
_KEPT = ("VAR", "VAR_INPUT", "VAR_OUTPUT")
"""The blocks whose variables belong to an instance."""


@dataclass(frozen=True, slots=True)
class Part:
    """A located part of a variable, whose type can be that of a tag, or is not divided further, such as a STRING.

    `path` follows the name of the variable, such as ``.fault`` or ``[2].run``. The part is the attribute or element `key` of the
    object that is reached from the variable's owner through `steps`.
    """

    path: str
    steps: tuple[Key, ...]
    key: Key
    type: ty.Type
    location: str
    block: str
    """The function block, in lower case, of which the part is a variable; "" for a member of a structure, and an element."""


def holders(unit: t.SourceUnit) -> frozenset[str]:
    """Return the names, in lower case, of the function blocks, classes and structures that have located parts."""
    members: dict[str, tuple[t.VarDecl, ...]] = {}
    for pou in unit.pous:
        if pou.kind in ("FUNCTION_BLOCK", "CLASS"):
            members[pou.name.lower()] = tuple(v for b in pou.blocks if b.kind in _KEPT for v in b.variables)
    for declared in unit.types:
        if isinstance(declared, t.StructDecl):
            members[declared.name.lower()] = declared.fields
        elif isinstance(declared, t.AliasDecl):
            members[declared.name.lower()] = (t.VarDecl(declared.pos, declared.name, declared.type, None),)
    found = {name for name, of in members.items() if any(v.location and not address_of(v.location) for v in of)}
    added = True
    while added:
        more = {
            name for name, of in members.items() if name not in found and any(type_name(v.type) in found for v in of)
        }
        found |= more
        added = bool(more)
    return frozenset(found)


def type_name(spec: t.TypeSpec) -> str:
    """Return the name in lower case of the type of a variable, or of the elements of an array; "" for a type without a name."""
    while isinstance(spec, t.ArrayType):
        spec = spec.of
    return spec.name.lower() if isinstance(spec, t.NamedType) else ""


class Parts:
    """Finds the located parts of the variables of a unit."""

    def __init__(self, unit: t.SourceUnit, declarations: Declarations) -> None:
        self._declarations = declarations
        self._pous = {pou.name.lower(): pou for pou in unit.pous}
        self._structs = {d.name.lower(): d for d in unit.types if isinstance(d, t.StructDecl)}
        self._holders = holders(unit)
        self._members: dict[str, list[tuple[str, Key, ty.Type, str]]] = {}
        """By structure or function block: the name, key, type and location of each member that is, or has, a located part."""

    def of(self, kind: ty.Type, key: Key, location: str = "") -> Iterator[Part]:
        """Yield the located parts of a variable with the attribute `key`. `location` is the address of the whole variable.

        The steps of each part begin at the owner of the variable.
        """
        yield from self._below(kind, "", (), key, location, "")

    def _below(
        self, kind: ty.Type, path: str, steps: tuple[Key, ...], key: Key, location: str, block: str
    ) -> Iterator[Part]:
        inner = (*steps, key)
        if isinstance(kind, ty.Array):
            if location or self._holds(kind):
                for at in product(*(range(high - low + 1) for low, high in kind.ranges)):
                    index = ",".join(str(i + low) for i, (low, _) in zip(at, kind.ranges, strict=True))
                    yield from self._below(kind.of, f"{path}[{index}]", (*inner, *at[:-1]), at[-1], location, "")
        elif isinstance(kind, ty.Struct) or (isinstance(kind, ty.Block) and kind.standard is None):
            if location or self._holds(kind):
                owner = kind.name.lower() if isinstance(kind, ty.Block) else ""
                for name, member, of, own in self._members_of(kind, every=bool(location)):
                    yield from self._below(of, f"{path}.{name}", inner, member, location or own, owner)
        elif location and path and not isinstance(kind, ty.Block):
            yield Part(path, steps, key, kind, location, block)

    def _holds(self, kind: ty.Type) -> bool:
        while isinstance(kind, ty.Array):
            kind = kind.of
        return isinstance(kind, ty.Struct | ty.Block) and kind.name.lower() in self._holders

    def _members_of(self, kind: ty.Struct | ty.Block, *, every: bool) -> Iterator[tuple[str, Key, ty.Type, str]]:
        """Yield the members that are, or have, a located part, or, of a located structure, every member."""
        name = kind.name.lower()
        if name not in self._members:
            self._members[name] = list(self._struct(kind) if isinstance(kind, ty.Struct) else self._block(name))
        return (m for m in self._members[name] if every or m[3] or self._holds(m[2]))

    def _struct(self, kind: ty.Struct) -> Iterator[tuple[str, Key, ty.Type, str]]:
        for field in self._structs[kind.name.lower()].fields:
            yield field.name, f"m_{field.name.lower()}", kind.fields[field.name.lower()][1], field.location

    def _block(self, name: str) -> Iterator[tuple[str, Key, ty.Type, str]]:
        pou = self._pous[name]
        with self._declarations.within(pou):
            for v in (v for b in pou.blocks if b.kind in _KEPT and "CONSTANT" not in b.qualifiers for v in b.variables):
                if address_of(v.location):
                    continue  # every instance has the variable of this address
                if v.location or type_name(v.type) in self._holders:
                    yield v.name, f"v_{v.name.lower()}", self._declarations.type_of(v.type), v.location
