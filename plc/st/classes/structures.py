"""Structures and unions that extend others (``TYPE Big EXTENDS Small : STRUCT``), additions of CODESYS and TwinCAT.

They get the members of their base before their own. A structure without members is also an addition of these dialects.
"""

from __future__ import annotations

from dataclasses import replace

from fieldtwin.gateway.core.files.error_collector import ErrorCollector
from fieldtwin.gateway.core.files.nearest import did_you_mean
from fieldtwin.plc.st.dialects import Dialect
from fieldtwin.plc.st.syntax import tree as t
from fieldtwin.plc.st.syntax.errors import invalid


def with_inherited_members(
    unit: t.SourceUnit, dialect: Dialect, errors: ErrorCollector
) -> tuple[t.SourceUnit, frozenset[str]]:
    """Return `unit` with the inherited members in its structures.

    The errors in declarations of structures are added to `errors`, and a base with an error is left out. Also return the
    structures, in lower case, that lack members for this reason. A base that was not imported is left to the compiler, which
    names the reason.
    """
    structures = {one.name.lower(): one for one in unit.types if isinstance(one, t.StructDecl)}
    hint = "the dialects codesys and twincat accept it"
    for one in structures.values() if not dialect.vendor else ():
        if one.union:
            errors.add(invalid(one.pos, f"{one.name} is a UNION, which is not in the standard", hint=hint))
        elif one.extends:
            errors.add(invalid(one.extends[0].pos, "EXTENDS of a structure is not in the standard", hint=hint))
        elif not one.fields:
            errors.add(invalid(one.pos, f"the structure {one.name} has no members", "at least one member", hint=hint))
    for one in structures.values():
        if one.union and not (one.extends or one.fields):
            errors.add(invalid(one.pos, f"the union {one.name} has no members", "at least one member"))
    missing = {one.name.lower() for one in unit.missing}
    done: dict[str, t.StructDecl] = {}
    incomplete: set[str] = set()

    def extended(one: t.StructDecl, below: tuple[str, ...]) -> t.StructDecl:
        key = one.name.lower()
        if key in done:
            return done[key]
        members: tuple[t.VarDecl, ...] = ()
        for base in one.extends:
            of = structures.get(base.name.lower())
            error = None
            if base.name.lower() in (*below, key):
                error = invalid(base.pos, f"{one.name} extends itself")
            elif len(one.extends) > 1:
                error = invalid(one.extends[1].pos, f"{one.name} extends two structures", "one name after EXTENDS")
            elif of is not None and of.union != one.union:
                what, other = ("UNION", "STRUCT") if one.union else ("STRUCT", "UNION")
                error = invalid(base.pos, f"{one.name} is a {what} and extends a {other}", f"the name of a {what}")
            elif of is not None:
                members = extended(of, (*below, key)).fields
            elif base.name.lower() not in missing:
                error = invalid(
                    base.pos,
                    f"EXTENDS {base.name}: {base.name!r} is not declared",
                    "a UNION" if one.union else "a STRUCT",
                    hint=did_you_mean(base.name, [each.name for each in structures.values()]),
                )
            if error is not None:
                errors.add(error)
            if error is not None or base.name.lower() in incomplete:
                incomplete.add(key)
        done[key] = replace(one, fields=(*members, *one.fields))
        return done[key]

    types = tuple(extended(one, ()) if isinstance(one, t.StructDecl) else one for one in unit.types)
    return replace(unit, types=types), frozenset(incomplete)
