"""The global variables that programs offer to the system file, to clients and to displays.

A program offers the global variables that it uses, also in the function blocks and functions that it calls: those with an address
or with located parts, and the retained ones. A variable in VAR_GLOBAL with an address that no program uses is offered by each of
them, because OpenPLC serves it to Modbus clients too.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from fieldtwin.plc.st.compiler.configurations.located import RETAIN, addresses_in, connections, located_in
from fieldtwin.plc.st.compiler.configurations.parts import holders, type_name
from fieldtwin.plc.st.syntax import tree as t
from fieldtwin.plc.st.syntax.addresses import address_of, short_name
from fieldtwin.plc.st.syntax.walk import nodes

_Key = tuple[str, str]
"""A global variable: its list and its name, in lower case."""


@dataclass(frozen=True, slots=True)
class Offered:
    """A global variable that a program uses, and that is retained, or has an address or located parts (`parts`).

    The program offers it, or its parts, as inputs, outputs or local variables. `name` is its name in the program, and `list` the
    name of its global list, in lower case. A `retain` variable keeps its value. An `unused` variable is used by no program.
    """

    name: str
    list: str
    variable: t.VarDecl
    retain: bool
    unused: bool = False


class Offers:
    """The global variables that the programs of a unit offer. `unit` is the result of `without_addresses`."""

    def __init__(self, unit: t.SourceUnit) -> None:
        self._unit = unit
        with_parts = holders(unit)
        self._retained = {
            (block.list.lower(), v.name.lower())
            for block in unit.globals
            if block.qualifiers & RETAIN
            for v in block.variables
        }
        self._located = {
            (block.list.lower(), v.name.lower()): v
            for block in unit.globals
            if "CONSTANT" not in block.qualifiers
            for v in block.variables
            if v.location or type_name(v.type) in with_parts or (block.list.lower(), v.name.lower()) in self._retained
        }
        located = reversed(self._located.items())
        self._by_address = {address_of(v.location): key for key, v in located if address_of(v.location)}
        self._used: dict[str, dict[_Key, str]] = {}
        """By program: the variables that it uses, with their names in the program."""

    def of(self, program: t.Pou) -> list[Offered]:
        """Return the global variables that a program offers, in the order of their declarations."""
        if not self._located:
            return []
        found, unused = self._used_by(program), self._unused()
        taken = {v.name.lower() for b in program.blocks if b.kind != "VAR_EXTERNAL" for v in b.variables}
        offers = []
        for key, v in self._located.items():
            if key not in found and key not in unused:
                continue
            name = found.get(key, v.name)
            if name.lower() in taken:
                address = address_of(v.location)
                name = short_name(address) if address else f"{key[0]}.{name}" if key[0] else name
            taken.add(name.lower() if not v.location else "")
            offers.append(Offered(name, key[0], v, key in self._retained, key in unused))
        return offers

    def _unused(self) -> set[_Key]:
        """Return the variables of VAR_GLOBAL with an address that no program uses, each address once."""
        used = {key for pou in self._unit.pous if pou.kind == "PROGRAM" for key in self._used_by(pou)}
        addresses = {address_of(self._located[key].location) for key in used}
        return {
            key
            for address, key in self._by_address.items()
            if address not in addresses and not self._located[key].name.startswith("%")
        }

    def _used_by(self, program: t.Pou) -> dict[_Key, str]:
        key = program.name.lower()
        if key not in self._used:
            self._used[key] = self._find(program)
        return self._used[key]

    def _find(self, program: t.Pou) -> dict[_Key, str]:
        found: dict[_Key, str] = {}

        def add(key: _Key | None) -> None:
            if key is not None:
                name = self._located[key].name
                found.setdefault(key, short_name(name) if name.startswith("%") else name)

        for pou in _reached(self._unit, program):
            own = {v.name.lower() for b in pou.blocks if b.kind != "VAR_EXTERNAL" for v in b.variables}
            external = (v for b in pou.blocks if b.kind == "VAR_EXTERNAL" for v in located_in([b]) if pou is program)
            for v in external:
                found[self._by_address[address_of(v.location)]] = v.name
                own.add(v.name.lower())
            for address in addresses_in(pou.blocks) if pou.kind != "PROGRAM" else ():
                add(self._by_address.get(address))
            for ref in _refs((pou.body, pou.actions, pou.methods)):
                add(self._global(ref, own))
        for ref in _refs(connections(self._unit, program.name.lower())):
            add(self._global(ref, set()))
        return found

    def _global(self, ref: t.Ref, own: set[str]) -> _Key | None:
        """Return the located global variable to which `ref` refers; None for any other reference."""
        if ref.name.startswith("%"):
            return self._by_address.get(ref.name)
        name = ref.name.lower()
        if name in own:
            return None
        first = ref.selectors[0] if ref.selectors else None
        if isinstance(first, t.Member) and (name, first.name.lower()) in self._located:
            return name, first.name.lower()
        return next((key for key in self._located if key[1] == name), None)


def _refs(tree: object) -> Iterator[t.Ref]:
    return (node for node in nodes(tree) if isinstance(node, t.Ref))


def _reached(unit: t.SourceUnit, program: t.Pou) -> list[t.Pou]:
    """Return a program and the POUs that it calls or contains, directly or through others, with their bases."""
    pous = {pou.name.lower(): pou for pou in unit.pous}
    types: dict[str, list[t.TypeSpec]] = {}
    for declared in unit.types:
        if not isinstance(declared, t.EnumDecl):
            inner = [v.type for v in declared.fields] if isinstance(declared, t.StructDecl) else [declared.type]
            types[declared.name.lower()] = inner
    instances = {v.name.lower(): v.type for block in unit.globals for v in block.variables}
    found, seen, waiting = [program], {program.name.lower()}, [program]
    while waiting:
        pou = waiting.pop(0)
        names = [*pou.extends]
        everything = [*nodes((pou.blocks, pou.body, pou.actions, pou.methods))]
        names += [node for node in everything if isinstance(node, t.NamedType)]
        used = {name.name.lower() for name in names}
        for ref in (node for node in everything if isinstance(node, t.Ref)):
            of_list = ref.selectors[0] if ref.selectors else None
            for name in (ref.name.lower(), of_list.name.lower() if isinstance(of_list, t.Member) else ""):
                used |= {n.name.lower() for n in nodes(instances.get(name)) if isinstance(n, t.NamedType)}
        used |= {node.ref.name.lower() for node in everything if isinstance(node, t.Call)}
        new = used - seen
        while new:
            seen |= new
            waiting += (more := [pous[name] for name in sorted(new) if name in pous])
            found += more
            inside = nodes(tuple(spec for name in new for spec in types.get(name, ())))
            new = {n.name.lower() for n in inside if isinstance(n, t.NamedType)} - seen
    return found
