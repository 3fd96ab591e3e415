"""Hints for misspelt names."""

from __future__ import annotations

import difflib
from collections.abc import Iterable

ALIKE = 0.5
"""The smallest similarity of two names (`difflib.SequenceMatcher.ratio`) at which one is suggested for the other."""


def did_you_mean(name: str, known: Iterable[str], otherwise: str = "") -> str:
    """Return a hint with the `known` name that is most similar to `name`, or `otherwise` if none is similar."""
    near = difflib.get_close_matches(name, list(known), n=1, cutoff=ALIKE)
    return f"did you mean {near[0]!r}?" if near else otherwise
