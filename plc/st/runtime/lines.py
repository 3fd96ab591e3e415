"""The attributes that keep the lines of the last assignments of variables."""

from __future__ import annotations

_PREFIX = "line_"


def line_of(attribute: str) -> str:
    """Return the attribute that keeps the line of the last assignment of `attribute`."""
    return f"{_PREFIX}{attribute}"


def is_line(attribute: str) -> bool:
    """Return whether an attribute keeps a line. Lines are not part of a program's state, because no scan depends on them."""
    return attribute.startswith(_PREFIX)
