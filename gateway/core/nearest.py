"""Hints for misspelt names."""

from __future__ import annotations

import difflib
from collections.abc import Iterable

ALIKE = 0.5
"""How much of two names has to agree (`difflib.SequenceMatcher.ratio`) for one to be meant by the other."""


def did_you_mean(name: str, known: Iterable[str], otherwise: str = "") -> str:
    """Return a hint with the `known` name that is most like `name`, or `otherwise` where none is like it."""
    near = difflib.get_close_matches(name, list(known), n=1, cutoff=ALIKE)
    return f"did you mean {near[0]!r}?" if near else otherwise
