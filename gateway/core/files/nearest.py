"""Suggestions for misspelt names."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable

MIN_SIMILARITY = 0.5
"""The smallest similarity of two names (`difflib.SequenceMatcher.ratio`) at which one is suggested for the other."""


def nearest(name: str, known: Iterable[str], most: int = 1) -> list[str]:
    """Return the `known` names that are similar to `name`, at most `most`, the most similar first. Case does not matter.

    A name that contains `name` as a whole word comes first: `supply_fan` for `fan`.
    """
    names = {k.lower(): k for k in known}
    whole = re.compile(rf"(?:^|.*[^a-z0-9]){re.escape(name.lower())}(?:[^a-z0-9].*|$)") if name else None
    longer = [k for k in names if whole is not None and whole.fullmatch(k)]
    alike = _by_similarity(name.lower(), longer, 0)
    alike += _by_similarity(name.lower(), [k for k in names if k not in longer], MIN_SIMILARITY)
    return [names[near] for near in alike[:most]]


def _by_similarity(name: str, known: Iterable[str], least: float) -> list[str]:
    """Return the names whose similarity to `name` is at least `least`, the most similar first. Equally similar names keep their
    order."""
    matcher = difflib.SequenceMatcher(b=name)
    found = []
    for each in known:
        matcher.set_seq1(each)
        if matcher.real_quick_ratio() >= least and matcher.quick_ratio() >= least and matcher.ratio() >= least:
            found.append((matcher.ratio(), each))
    return [each for _, each in sorted(found, key=lambda one: -one[0])]


def did_you_mean(name: str, known: Iterable[str], otherwise: str = "") -> str:
    """Return a hint with the `known` name that is most similar to `name`, or return `otherwise` if no name is similar."""
    near = nearest(name, known)
    return f"did you mean {near[0]!r}?" if near else otherwise
