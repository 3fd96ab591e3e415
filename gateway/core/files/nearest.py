"""Suggestions for misspelt names."""

from __future__ import annotations

import difflib
from collections.abc import Iterable

ALIKE = 0.5
"""The smallest similarity of two names (`difflib.SequenceMatcher.ratio`) at which one is suggested for the other."""


def nearest(name: str, known: Iterable[str], most: int = 1) -> list[str]:
    """Return the `known` names that are similar to `name`, at most `most`, the most similar first. Case does not matter."""
    names = {k.lower(): k for k in known}
    return [names[near] for near in difflib.get_close_matches(name.lower(), names, n=most, cutoff=ALIKE)]


def did_you_mean(name: str, known: Iterable[str], otherwise: str = "") -> str:
    """Return a hint with the `known` name that is most similar to `name`, or `otherwise` if none is similar."""
    near = nearest(name, known)
    return f"did you mean {near[0]!r}?" if near else otherwise
