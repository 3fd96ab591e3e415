"""Local variables of function blocks that can be read from outside: for unit tests, and for the expressions of proofs."""

from __future__ import annotations

from dataclasses import replace

from fieldtwin.plc.st.syntax import tree as t

READABLE = "READABLE"
"""A modifier of a POU whose steps can be read from outside. The steps become variables later (`fieldtwin.plc.st.charts`)."""
_STATED = {"PUBLIC", "PROTECTED", "PRIVATE", "INTERNAL", "CONSTANT"}


def readable(pou: t.Pou) -> t.Pou:
    """Return a POU; if it is a function block or class, with public steps and local variables, except variables that
    state their access.
    """
    if pou.kind not in ("FUNCTION_BLOCK", "CLASS"):
        return pou
    blocks = (
        replace(block, qualifiers=block.qualifiers | {"PUBLIC"})
        if block.kind == "VAR" and not block.qualifiers & _STATED
        else block
        for block in pou.blocks
    )
    return replace(pou, blocks=tuple(blocks), modifiers=pou.modifiers | {READABLE})
