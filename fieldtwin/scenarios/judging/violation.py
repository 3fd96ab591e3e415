"""A broken rule of a scenario, with the time at which it was broken."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Violation:
    """A broken rule. `since_s` is the time from which it was checked; `where` is the file and line of the rule, or of the
    logic that failed. `bound_s` is the rule's time limit in seconds: if the host was late by a part of it, the violation proves
    nothing.
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
