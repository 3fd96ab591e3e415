"""Test suites of TcUnit in the source of a program: a plant does not execute them; `fieldtwin test` runs them without TcUnit."""

from __future__ import annotations

from dataclasses import replace

from fieldtwin.plc.st.syntax import tree as t
from fieldtwin.plc.st.syntax.walk import nodes

SUITE = "FB_TestSuite"
"""The name of the function block of TcUnit that each suite extends."""
_LIBRARY = "tcunit"


def is_suite(pou: t.Pou) -> bool:
    """Return whether a function block is a test suite."""
    return any(kind.name.rpartition(".")[2].lower() == SUITE.lower() for kind in pou.extends)


def without_suites(unit: t.SourceUnit) -> t.SourceUnit:
    """Return `unit` without its test suites and the POUs that use them or TcUnit, all of which become missing declarations.

    A unit that declares FB_TestSuite itself is returned as it is.
    """
    if any(pou.name.rpartition(".")[2].lower() == SUITE.lower() for pou in unit.pous):
        return unit
    left_out: set[str] = {pou.name.lower() for pou in unit.pous if is_suite(pou)}
    users = [(pou, _used(pou)) for pou in unit.pous]
    size = -1
    while size < len(left_out):
        size = len(left_out)
        left_out |= {pou.name.lower() for pou, used in users if used & (left_out | {_LIBRARY})}
    missing = tuple(
        t.Missing(pou.pos, pou.kind.lower().replace("_", " "), pou.name, f"{pou.name} belongs to the tests of TcUnit")
        for pou in unit.pous
        if pou.name.lower() in left_out
    )
    if not missing:
        return unit
    pous = tuple(pou for pou in unit.pous if pou.name.lower() not in left_out)
    return replace(unit, pous=pous, missing=(*unit.missing, *missing))


def _used(pou: t.Pou) -> set[str]:
    """Return the names in lower case of the types that a POU uses, and TcUnit if its statements use the library."""
    own = {v.name.lower() for block in pou.blocks for v in block.variables}
    found: set[str] = set()
    for node in nodes((pou.blocks, pou.body, pou.actions, pou.methods, pou.extends)):
        if isinstance(node, t.NamedType):
            found |= {node.name.lower(), node.name.partition(".")[0].lower()}
        elif isinstance(node, t.Ref) and node.name.lower() == _LIBRARY and _LIBRARY not in own:
            found.add(_LIBRARY)
    return found
