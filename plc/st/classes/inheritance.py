"""Inheritance (IEC 61131-3:2013, 6.6.5.5 and 6.6.6.4): which POU extends and implements which, and the inherited variables.

A POU that extends another one gets the variables of the other one before its own, so that its instances hold all of them.
Methods stay where they are declared; `fieldtwin.plc.st.compiler.pous.hierarchy` combines them.
"""

from __future__ import annotations

from dataclasses import replace

from fieldtwin.gateway.core.files.error_collector import ErrorCollector
from fieldtwin.gateway.core.files.nearest import did_you_mean
from fieldtwin.plc.blocks import BLOCKS
from fieldtwin.plc.st.syntax import tree as t
from fieldtwin.plc.st.syntax.errors import invalid

MAX_BASES = 32
"""How many POUs may be above one, from base to base."""
INHERITED = "INHERITED"
"""The qualifier of a block of variables that comes from a base."""
_BASES = {"FUNCTION_BLOCK": ("FUNCTION_BLOCK", "CLASS"), "CLASS": ("CLASS",), "INTERFACE": ("INTERFACE",)}
_NAMES = {"FUNCTION_BLOCK": "a FUNCTION_BLOCK", "CLASS": "a CLASS", "INTERFACE": "an INTERFACE"}
_STANDARD = frozenset(name.lower() for name in BLOCKS)


def with_inherited(unit: t.SourceUnit, errors: ErrorCollector) -> tuple[t.SourceUnit, frozenset[str]]:
    """Return `unit` with the inherited variables in its POUs, each base before the POUs that extend it.

    Charts and edges must have been translated before. The errors in EXTENDS and IMPLEMENTS are added to `errors`, and the names
    with an error are left out. Also return the POUs, in lower case, that lack variables and methods for this reason. A base that
    was not imported is left to the compiler, which names the reason.
    """
    if not any(pou.extends or pou.implements for pou in unit.pous):
        return unit, frozenset()
    order = _Order(unit, errors)
    for pou in unit.pous:
        order.add(pou, ())
    return replace(unit, pous=tuple(order.done.values())), frozenset(order.incomplete)


class _Order:
    """The POUs of a unit, each after its bases."""

    def __init__(self, unit: t.SourceUnit, errors: ErrorCollector) -> None:
        self.errors = errors
        self.incomplete: set[str] = set()
        """The POUs that do not inherit everything, because of an error, in lower case."""
        self.done: dict[t.Pos, t.Pou] = {}
        """By position: the POUs with their inherited variables."""
        self._pous = {pou.name.lower(): pou for pou in unit.pous}
        self._missing = {one.name.lower() for one in unit.missing}

    def add(self, pou: t.Pou, below: tuple[t.Pou, ...]) -> None:
        """Add a POU after its bases. `below` are the POUs that extend it, from the first to the last."""
        if pou.pos in self.done:
            return
        implements = tuple(name for name in pou.implements if self._is_right(pou, name, implements=True))
        extends = [name for name in pou.extends if self._is_right(pou, name, implements=False)]
        if len(pou.extends) > 1 and pou.kind != "INTERFACE":
            self._bad(pou.extends[1].pos, f"{pou.name} extends two POUs", "one name after EXTENDS")
            del extends[1:]
        extends = [name for name in extends if self._is_added(pou, name, (*below, pou))]
        bases = {name.name.lower() for name in extends}
        if len(extends) < len(pou.extends) or bases & self.incomplete:
            self.incomplete.add(pou.name.lower())
        self.done[pou.pos] = self._extended(replace(pou, extends=tuple(extends), implements=implements))

    def _is_added(self, pou: t.Pou, name: t.NamedType, path: tuple[t.Pou, ...]) -> bool:
        """Add the base `name` of a POU; return whether this is possible. `path` are the POUs that extend it."""
        base = self._pous.get(name.name.lower())
        if base is None:
            return True  # it was not imported
        if base in path:
            chain = " -> ".join(one.name for one in (*path[path.index(base) :], base))
            self._bad(name.pos, f"{pou.name} extends itself: {chain}")
            return False
        if len(path) > MAX_BASES:
            self._bad(name.pos, "a base extends others too often", f"at most {MAX_BASES} bases")
            return False
        self.add(base, path)
        return True

    def _extended(self, pou: t.Pou) -> t.Pou:
        found = [self._pous.get(name.name.lower()) for name in pou.extends[:1] if pou.kind != "INTERFACE"]
        base = self.done.get(found[0].pos) if found and found[0] is not None else None
        if base is None:
            return pou
        for variable in (v for block in base.blocks for v in block.variables if v.edge):
            self._bad(variable.pos, f"{variable.edge} of {variable.name}", f"no edge in a POU that {pou.name} extends")
        return replace(pou, blocks=(*(b for block in base.blocks for b in _inherited(base, block)), *pou.blocks))

    def _is_right(self, pou: t.Pou, name: t.NamedType, *, implements: bool) -> bool:
        """Return whether a POU may extend or implement `name`. A name that was not imported counts as right."""
        allowed = ("INTERFACE",) if implements else _BASES.get(pou.kind, ())
        expected = " or ".join(_NAMES[kind] for kind in allowed)
        word = "IMPLEMENTS" if implements else "EXTENDS"
        found = self._pous.get(name.name.lower())
        if found is None and name.name.lower() in self._missing:
            return True
        if found is None and name.name.lower() in _STANDARD:
            self._bad(name.pos, f"{word} {name.name}: a standard function block cannot be extended", expected)
        elif found is None:
            known = [one.name for one in self._pous.values() if one.kind in allowed]
            hint = did_you_mean(name.name, known)
            self._bad(name.pos, f"{word} {name.name}: {name.name!r} is not declared", expected, hint)
        elif found.kind not in allowed:
            self._bad(name.pos, f"{word} {name.name}, which is a {found.kind}", expected)
        elif "FINAL" in found.modifiers:
            self._bad(name.pos, f"{pou.name} extends {found.name}, which is FINAL")
        else:
            return True
        return False

    def _bad(self, pos: t.Pos, message: str, expected: str = "", hint: str = "") -> None:
        self.errors.add(invalid(pos, message, expected, hint=hint))


def _inherited(base: t.Pou, block: t.VarBlock) -> tuple[t.VarBlock, ...]:
    """Return what a POU inherits of a block of its base: nothing of variables that exist only while the base is executed."""
    if block.kind == "VAR_EXTERNAL" or (block.kind == "VAR_TEMP" and not base.actions):
        return ()
    if block.kind == "VAR_TEMP":  # actions of the base use its temporary variables, so an instance has them
        return (replace(block, kind="VAR", qualifiers=block.qualifiers | {INHERITED, "PRIVATE"}),)
    return (replace(block, qualifiers=block.qualifiers | {INHERITED}),)
