"""How a late host affects a deadline.

Outside virtual time, the system under test and the test runner share a host. The runner measures by how much its own
sleeps ended too late: only the host can cause that, and it is subtracted. A reaction that is later than the deadline after
this subtraction, but within the whole observed lateness (slow answers, late scans), proves nothing, because the host or the
system may be the cause. An even later reaction fails the check.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from fieldtwin.gateway.core.conditions.expression import Expression
from fieldtwin.scenarios.bench import Bench, Can

BUDGET = 2.0
"""The limit for a late host: a check may exceed its own time limit by at most this multiple of it. After that the check is
INCONCLUSIVE.
"""
LOOK_S = 0.03
"""The longest time in seconds between a reaction and the check that sees it, because the runner checks periodically."""


@dataclass(frozen=True)
class Allowance:
    """The allowance for one deadline, in seconds: `own_s` is subtracted, and the runner waits until `any_s`.

    `exhausted`: the host was later than the budget. `applies`: whether lateness can be subtracted from this check at
    all.
    """

    limit_s: float = 0.0
    own_s: float = 0.0
    any_s: float = 0.0
    exhausted: bool = False
    applies: bool = False

    def in_time(self, took_s: float) -> bool:
        """Return whether a reaction after `took_s` was in time, after subtracting the host's own lateness."""
        return not self.applies or took_s <= self.limit_s + self.own_s + LOOK_S


def allowance(bench: Bench, since_s: float, limit_s: float, expressions: Iterable[Expression] = ()) -> Allowance:
    """Return the allowance for a deadline of `limit_s` seconds that began at `since_s`.

    Nothing is subtracted on a plant, which is responsible for its own lateness, nor from a check of the lateness of
    scans, nor if an expression contains a time itself (``age(T) <= 2 s``): that time cannot be prolonged.
    """
    named = any(one.asks_lateness or one.times_s for one in expressions)
    if named or limit_s <= 0 or bench.target == "real" or Can.EXACT_TIME in bench.can:
        return Allowance(limit_s)
    own_s, any_s = bench.host_late_total_s(since_s)
    most_s = BUDGET * limit_s
    return Allowance(
        limit_s, min(own_s, most_s), min(max(own_s, any_s), most_s), max(own_s, any_s) > most_s, applies=True
    )
