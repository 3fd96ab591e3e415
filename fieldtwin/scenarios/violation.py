"""A rule of a scenario that was broken, with the moment that it was broken at."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Violation:
    """A broken rule. `since_s`: when the time that it looked at began; `where`: the rule's file and line, or that of the logic
    that failed. `bound_s`: the time that the rule is about; a host that was late by a part of it has proved nothing."""

    number: str
    expected: str
    got: str
    names: tuple[str, ...]
    bound_s: float
    since_s: float
    where: str = ""
    asks_lateness: bool = False
    nobody_knows: bool = False
    """The host was late, and whether the rule is broken cannot be told."""
