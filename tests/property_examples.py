"""How many examples property tests try: a third of them in the fast tests, all of them in the long tests and by hand."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from hypothesis import is_hypothesis_test, settings

FEWEST = 10
"""Property tests with at most this many examples try all of them."""

SETTINGS = "_hypothesis_internal_use_settings"
"""Hypothesis has no public access to the settings of a test; its own plugin for pytest uses this name."""

_reduced: set[int] = set()


def has_examples(test: object) -> bool:
    """Return whether `test` is a property test with a number of examples. Tests of state machines are not."""
    return is_hypothesis_test(test) and getattr(test, SETTINGS, None) is not None


def reduce_examples(test: Callable[..., Any]) -> None:
    """Let a property test try a third of its examples. The same test may be given several times, with different parameters."""
    function = getattr(test, "__func__", test)
    if id(function) not in _reduced:
        _reduced.add(id(function))
        every = getattr(function, SETTINGS)
        setattr(function, SETTINGS, settings(every, max_examples=fewer(every.max_examples)))


def fewer(examples: int) -> int:
    """Return how many of `examples` a fast test tries."""
    return min(examples, max(FEWEST, examples // 3))
