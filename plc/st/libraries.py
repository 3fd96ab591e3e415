"""Libraries: folders of Structured Text from which a program takes the declarations that it uses, by their names.

Other declarations of a library are not compiled, so an error in one of them does not concern the program. The program's own
declarations have precedence over those of libraries, and a library over those that are named after it.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.gateway.core.files.error_collector import ErrorCollector
from fieldtwin.plc.st.syntax import tree as t
from fieldtwin.plc.st.syntax.walk import nodes, with_parts

STANDARD_NAMES = frozenset({"standard", "tc2_standard", "tc2_system", "sysmem"})
"""The names in lower case under which CODESYS and TwinCAT have the standard functions and function blocks."""
Declaration = t.TypeDecl | t.VarBlock | t.Pou


@dataclass
class Library:
    """The declarations of libraries by each name, in lower case, that refers to them; `broken` has those with a syntax error."""

    found: dict[str, Declaration] = field(default_factory=dict)
    broken: dict[str, FileInvalid] = field(default_factory=dict)
    units: list[t.SourceUnit] = field(default_factory=list)
    """The files, for their warnings and for what was not imported from them."""

    def add(self, unit: t.SourceUnit) -> None:
        """Add the declarations of a file."""
        self.units.append(unit)
        for pou in unit.pous:
            self._name(pou.name, pou)
        for declared in unit.types:
            self._name(declared.name, declared)
            for value, _ in declared.values if isinstance(declared, t.EnumDecl) else ():
                self._name(value, declared)
        for block in unit.globals:
            for name in (block.list, *(v.name for v in block.variables)):
                self._name(name, block)

    def _name(self, name: str, declared: Declaration) -> None:
        if name and name.lower() not in self.broken:
            self.found.setdefault(name.lower(), declared)

    def fail(self, names: Iterable[str], error: FileInvalid) -> None:
        """Add the names of a part of a file that cannot be parsed."""
        for name in names:
            if name.lower() not in self.found:
                self.broken.setdefault(name.lower(), error)


def with_library(unit: t.SourceUnit, library: Library) -> t.SourceUnit:
    """Return `unit` with the declarations of `library` that it uses, directly or through others.

    Raises `FileInvalid` for a used declaration with a syntax error, with the others.
    """
    errors = ErrorCollector()
    own = {declared.name.lower() for declared in (*unit.types, *unit.pous)}
    own |= {v.name.lower() for block in unit.globals for v in block.variables}
    taken: dict[int, Declaration] = {}
    waiting = list(_names(unit))
    seen = set(own)
    while waiting:
        name = waiting.pop()
        if name in seen:
            continue
        seen.add(name)
        declared = library.found.get(name)
        if name in library.broken:
            errors.add(library.broken[name])
        elif declared is not None and id(declared) not in taken:
            taken[id(declared)] = declared
            waiting += _names(declared)
    errors.raise_all()
    files = {declared.pos.path for declared in taken.values()}
    return t.SourceUnit(
        (*unit.types, *(d for d in taken.values() if isinstance(d, t.TypeDecl))),
        (*unit.globals, *(d for d in taken.values() if isinstance(d, t.VarBlock))),
        (*unit.pous, *(d for d in taken.values() if isinstance(d, t.Pou))),
        (*unit.warnings, *(w for one in library.units for w in one.warnings if w.path in files)),
        (*unit.missing, *(m for one in library.units for m in one.missing if _owner(m) in seen)),
        unit.instances,
        unit.tests,
        unit.tasks,
        unit.configured,
    )


def without_qualifiers(unit: t.SourceUnit, names: frozenset[str]) -> t.SourceUnit:
    """Return `unit` without the names of libraries before the names of their declarations, such as ``Tc2_Standard.TON``.

    `names` are those of the libraries, in lower case. A variable, list or namespace with such a name has precedence.
    """
    own = {v.name.lower() for block in unit.globals for v in block.variables} | {b.list.lower() for b in unit.globals}
    own |= {declared.within.namespace.lower().partition(".")[0] for declared in (*unit.types, *unit.pous)}
    names -= own
    if not any(_qualified(node, names) for node in nodes(unit)):
        return unit

    def changed(node: Any, known: frozenset[str]) -> Any:
        if isinstance(node, t.Pou | t.Test):
            known -= {v.name.lower() for block in node.blocks for v in block.variables}
        if _qualified(node, known):
            if isinstance(node, t.Ref):
                first = node.selectors[0]
                assert isinstance(first, t.Member)
                node = replace(node, name=first.name, selectors=node.selectors[1:])
            elif isinstance(node, t.Literal):
                node = replace(node, text=node.text.partition(".")[2])
            else:
                node = replace(node, name=node.name.partition(".")[2])
        return with_parts(node, lambda part: changed(part, known))

    found: t.SourceUnit = changed(unit, names)
    return found


def _qualified(node: Any, names: frozenset[str]) -> bool:
    """Return whether a node is a name with the name of a library before it."""
    if isinstance(node, t.Ref):
        return node.name.lower() in names and bool(node.selectors) and isinstance(node.selectors[0], t.Member)
    if isinstance(node, t.NamedType | t.SubrangeType):
        return "." in node.name and node.name.lower().partition(".")[0] in names
    if isinstance(node, t.Literal) and node.kind == "ENUM_REF":
        return "." in node.text and node.text.lower().partition(".")[0] in names
    return False


def _owner(missing: t.Missing) -> str:
    """Return the name of a missing declaration, or of the POU to which a missing action belongs, in lower case."""
    return missing.name.lower().partition(".")[0]


def _names(root: Any) -> Iterator[str]:
    """Yield the names, in lower case, of types, variables and POUs to which a declaration may refer."""
    parts = [*root.types, *root.globals, *root.pous, *root.tests] if isinstance(root, t.SourceUnit) else [root]
    for part in parts:
        if isinstance(part, t.Pou):
            yield from _of_pou(part, frozenset())
        elif isinstance(part, t.Test):
            yield from _of_variables(part, frozenset())
        else:
            yield from _references(part, frozenset())


def _of_pou(pou: t.Pou, outer: frozenset[str]) -> Iterator[str]:
    """Yield the names of a POU and its methods. `outer` are the variables of the owner of a method."""
    yield from _of_variables(replace(pou, methods=()), outer)
    own = outer | {v.name.lower() for b in pou.blocks if b.kind != "VAR_EXTERNAL" for v in b.variables}
    for method in pou.methods:
        yield from _of_pou(method, own)


def _of_variables(part: t.Pou | t.Test, outer: frozenset[str]) -> Iterator[str]:
    """Yield the names of a part that declares variables. `outer` are further variables that it can use."""
    own = outer | {v.name.lower() for b in part.blocks if b.kind != "VAR_EXTERNAL" for v in b.variables}
    yield from (v.name.lower() for b in part.blocks if b.kind == "VAR_EXTERNAL" for v in b.variables)
    yield from _references(part, own)


def _references(root: Any, local: frozenset[str]) -> Iterator[str]:
    for node in nodes(root):
        if isinstance(node, t.Call):  # a function may have the name of a local variable
            yield node.ref.name.lower()
        if isinstance(node, t.NamedType | t.SubrangeType) or (
            isinstance(node, t.Ref) and node.name.lower() not in local
        ):
            yield node.name.rpartition(".")[2].lower()
            first = node.selectors[0] if isinstance(node, t.Ref) and node.selectors else None
            if isinstance(first, t.Member):  # the name of a library may stand before the name
                yield first.name.lower()
        elif isinstance(node, t.Literal) and node.kind == "ENUM_REF":
            yield node.text.partition("#")[0].rpartition(".")[2].lower()
