"""What a host that was late means for a deadline.

Off virtual time the system under test and its judge share a host. The judge measures by how much its own sleeps ended too late:
that is the host alone, and it is subtracted. A reaction that came later than that, but within all lateness that was seen (answers
that took long, scans that began late), proves nothing: that may be the host or the system. One that is later still has failed.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from fieldtwin.scenarios.bench import Bench, Can
from fieldtwin.scenarios.expression import Expression

BUDGET = 2.0
"""The time budget of a late host: a check takes at most so many times its own time longer. After that nobody knows."""
LOOK_S = 0.03
"""A reaction is seen by the next look, and later than it was."""


@dataclass(frozen=True)
class Allowance:
    """Of one deadline, in seconds: `own_s` is subtracted; until `any_s` the judge waits. `exhausted`: the host was later than the
    budget. `applies`: whether lateness can be subtracted from this check at all."""

    limit_s: float = 0.0
    own_s: float = 0.0
    any_s: float = 0.0
    exhausted: bool = False
    applies: bool = False

    def in_time(self, took_s: float) -> bool:
        """Whether a reaction after `took_s` was in time, the host's own lateness subtracted."""
        return not self.applies or took_s <= self.limit_s + self.own_s + LOOK_S


def allowance(bench: Bench, since_s: float, limit_s: float, expressions: Iterable[Expression] = ()) -> Allowance:
    """Of a deadline of `limit_s` seconds that runs since `since_s`.

    Nothing is subtracted on a plant, which answers for its own lateness, nor from a check that asks how late scans are, nor where
    an expression names a time itself (``age(T) <= 2 s``): that time cannot be prolonged.
    """
    named = any(one.asks_lateness or one.times_s for one in expressions)
    if named or limit_s <= 0 or bench.target == "real" or Can.EXACT_TIME in bench.can:
        return Allowance(limit_s)
    own_s, any_s = bench.host_late_total_s(since_s)
    most_s = BUDGET * limit_s
    return Allowance(
        limit_s, min(own_s, most_s), min(max(own_s, any_s), most_s), max(own_s, any_s) > most_s, applies=True
    )
