"""Namespaces (IEC 61131-3:2013, 6.9): each declaration gets its full name, such as ``Plant.Drives.Motor``, and so does its use.

A name is looked up in the namespace of the POU that uses it and in those around it, then in the namespaces after USING. The
global variables of a namespace are a list with the name of the namespace. Names of other variables, and those of methods,
belong to no namespace and stay as they are.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from fieldtwin.gateway.core.files.error_collector import ErrorCollector
from fieldtwin.gateway.core.files.nearest import did_you_mean
from fieldtwin.plc.st.syntax import tree as t
from fieldtwin.plc.st.syntax.errors import invalid
from fieldtwin.plc.st.syntax.walk import with_parts


def with_full_names(unit: t.SourceUnit) -> t.SourceUnit:
    """Return `unit` with full names in place of those that namespaces and USING shorten.

    Raises `FileInvalid` with line and column for the first unknown namespace or ambiguous name, and with the others.
    """
    variables = [_Global(v.name, t.Within(b.namespace)) for b in unit.globals if b.namespace for v in b.variables]
    declared = (*unit.types, *unit.pous, *variables)
    if not any(one.within.namespace or one.within.using for one in (*declared, *unit.tests)):
        return unit
    names = _Names(declared)
    for one in (*unit.types, *unit.pous, *unit.tests):
        names.check(one.within)
    renamed = replace(
        unit,
        types=tuple(_Renaming(names, one.within).declaration(one) for one in unit.types),
        pous=tuple(_Renaming(names, one.within).declaration(one) for one in unit.pous),
        globals=tuple(_Renaming(names, t.Within(block.namespace)).changed(block) for block in unit.globals),
        tests=tuple(_Renaming(names, one.within, _own(one)).changed(one) for one in unit.tests),
    )
    names.errors.raise_all()
    return renamed


@dataclass(frozen=True, slots=True)
class _Global:
    """A global variable of a namespace."""

    name: str
    within: t.Within


_Declared = t.TypeDecl | t.Pou | _Global


def _full(one: _Declared) -> str:
    return f"{one.within.namespace}.{one.name}" if one.within.namespace else one.name


class _Names:
    """The full names that a unit declares, by the full name in lower case."""

    def __init__(self, declared: Sequence[_Declared]) -> None:
        self.errors = ErrorCollector()
        self._types: dict[str, _Declared] = {
            _full(one).lower(): one for one in declared if not isinstance(one, _Global)
        }
        self._all = {**{_full(one).lower(): one for one in declared if isinstance(one, _Global)}, **self._types}
        self._namespaces = {name for one in declared for name in _enclosing(one.within.namespace.lower()) if name}

    def check(self, within: t.Within) -> None:
        """Add an error for each namespace after USING that does not exist."""
        for using in within.using:
            if using.name.lower() not in self._namespaces:
                hint = did_you_mean(using.name, sorted(self._namespaces))
                self.fail(using.pos, f"a namespace {using.name!r} is not declared", hint)

    def fail(self, pos: t.Pos, message: str, hint: str = "") -> None:
        self.errors.add(invalid(pos, message, hint=hint))

    def find(
        self, parts: Sequence[str], within: t.Within, pos: t.Pos, *, variables: bool = False
    ) -> tuple[_Declared, int] | None:
        """Return the declaration to which a name refers, and how many of its `parts` belong to the name of the declaration.

        With `variables` it may also be a global variable.
        """
        known = self._all if variables else self._types
        for outer in _enclosing(within.namespace.lower()):
            found = self._below(known, outer, parts)
            if found is not None:
                return found
        others: dict[str, tuple[_Declared, int]] = {}
        others |= {
            _full(one[0]): one for using in within.using if (one := self._below(known, using.name.lower(), parts))
        }
        if len(others) > 1:
            self.fail(pos, f"{'.'.join(parts)} is declared in several namespaces: {', '.join(sorted(others))}")
        return next(iter(others.values()), None)

    @staticmethod
    def _below(known: Mapping[str, _Declared], outer: str, parts: Sequence[str]) -> tuple[_Declared, int] | None:
        for count in range(len(parts), 0, -1):
            name = ".".join((*([outer] if outer else []), *parts[:count])).lower()
            if name in known:
                return known[name], count
        return None


def _enclosing(namespace: str) -> Iterator[str]:
    """Yield a namespace, those around it, and last the global one, ``""``."""
    while namespace:
        yield namespace
        namespace = namespace.rpartition(".")[0]
    yield ""


def _own(part: t.Pou | t.Test) -> frozenset[str]:
    """Return the names of variables, methods and actions of a POU, and of its result, in lower case."""
    found = {v.name.lower() for block in part.blocks for v in block.variables}
    if isinstance(part, t.Pou):
        names = (part.name, *(method.name for method in part.methods), *(action.name for action in part.actions))
        found |= {name.lower() for name in names}
    return frozenset(found)


@dataclass(frozen=True)
class _Renaming:
    """The change of the names in one declaration. `local` are names that belong to no namespace, in lower case."""

    names: _Names
    within: t.Within
    local: frozenset[str] = frozenset()

    def declaration(self, one: Any) -> Any:
        """Return a declaration with its full name and with the full names of what it uses."""
        if isinstance(one, t.Pou):
            one = self._without_externals(one)
        inner = replace(self, local=_own(one)) if isinstance(one, t.Pou) else self
        return replace(inner.changed(one), name=_full(one))

    def _without_externals(self, pou: t.Pou) -> t.Pou:
        """Return a POU without the VAR_EXTERNAL of global variables of a namespace, which it then uses by their full names."""

        def kept(v: t.VarDecl) -> bool:
            found = self.names.find([v.name], self.within, v.pos, variables=True)
            return found is None or not isinstance(found[0], _Global)

        blocks = (
            replace(b, variables=tuple(v for v in b.variables if kept(v))) if b.kind == "VAR_EXTERNAL" else b
            for b in pou.blocks
        )
        return replace(pou, blocks=tuple(blocks))

    def changed(self, node: Any) -> Any:
        """Return a part of the tree with full names."""
        if isinstance(node, t.Pou) and node.kind in t.METHODS:
            return with_parts(node, replace(self, local=self.local | _own(node)).changed)
        if isinstance(node, t.NamedType | t.SubrangeType):
            found = self.names.find(node.name.split("."), self.within, node.pos)
            node = replace(node, name=_full(found[0])) if found is not None else node
        elif isinstance(node, t.Literal) and node.kind == "ENUM_REF":
            kind, _, value = node.text.partition("#")
            found = self.names.find(kind.split("."), self.within, node.pos)
            return replace(node, text=f"{_full(found[0])}#{value}") if found is not None else node
        elif isinstance(node, t.Call):
            return replace(node, ref=self._ref(node.ref, called=True), arguments=self.changed(node.arguments))
        elif isinstance(node, t.Ref):
            return self._ref(node, called=False)
        return with_parts(node, self.changed)

    def _ref(self, ref: t.Ref, *, called: bool) -> t.Ref:
        ref = replace(ref, selectors=self.changed(ref.selectors))
        if ref.name.lower() in self.local:
            return ref
        members = []
        for selector in ref.selectors:
            if not isinstance(selector, t.Member):
                break
            members.append(selector.name)
        found = self.names.find([ref.name, *members], self.within, ref.pos, variables=True)
        if found is None:
            return ref
        declared, count = found
        if isinstance(declared, _Global):
            member = t.Member(ref.pos, declared.name)
            return replace(ref, name=declared.within.namespace, selectors=(member, *ref.selectors[count - 1 :]))
        of_enum = isinstance(declared, t.EnumDecl) and len(members) >= count
        if not of_enum and not (called and isinstance(declared, t.Pou) and count > len(members)):
            return ref
        return replace(ref, name=_full(declared), selectors=ref.selectors[count - 1 :])
