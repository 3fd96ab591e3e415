"""A broken rule of a scenario, with the time at which it was broken."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Violation:
    """A broken rule. `since_s` is the start of the time that it checked; `where` is the rule's file and line, or that
    of the logic that failed. `bound_s` is the time that the rule is about: if the host was late by a part of this time, the
    violation proves nothing.
    """

    number: str
    expected: str
    got: str
    names: tuple[str, ...]
    bound_s: float
    since_s: float
    where: str = ""
    asks_lateness: bool = False
    undecidable: bool = False
    """Whether the host was so late that the runner cannot decide whether the rule is broken."""
