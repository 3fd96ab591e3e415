"""The outcome of a plan: each variable over the horizon, and each requirement with the time at which it first did not
hold.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.values import Quality, TagValue


@dataclass(slots=True)
class VariableOutcome:
    """A tag or a program's variable: its number of updates, and statistics of its good values.

    The mean is weighted by time, so that a different sampling period, which plans are about, does not change it.
    """

    updates: int = 0
    good: int = 0
    lowest: float = math.inf
    highest: float = -math.inf
    first: Any = None
    last: Any = None
    _weighed: float = 0.0
    _spent_ns: int = 0
    _held: float | None = None
    _since_ns: int = 0

    def saw(self, value: Any, good: bool, t_ns: int) -> None:
        """Record a value at `t_ns` of the fork's monotonic clock."""
        self.updates += 1
        self.ends(t_ns)
        if not good or value is None:
            return
        self.good += 1
        if self.first is None:
            self.first = value
        self.last = value
        if isinstance(value, int | float) and not math.isnan(value):
            self._held, self._since_ns = value, t_ns
            self.lowest, self.highest = min(self.lowest, value), max(self.highest, value)

    def ends(self, t_ns: int) -> None:
        """End the interval of the last value at `t_ns`, and add the value to the mean."""
        if self._held is not None and t_ns > self._since_ns:
            self._weighed += self._held * (t_ns - self._since_ns)
            self._spent_ns += t_ns - self._since_ns
        self._held = None

    @property
    def mean(self) -> float | None:
        """Return the mean over time; None if there was never a number."""
        if self._spent_ns:
            return self._weighed / self._spent_ns
        return self.lowest if self.lowest <= self.highest else None

    def described(self) -> dict[str, Any]:
        shown: dict[str, Any] = {
            "updates": self.updates,
            "good": self.good,
            "first": _shown(self.first),
            "last": _shown(self.last),
        }
        if (mean := self.mean) is not None:
            shown |= {"min": self.lowest, "max": self.highest, "mean": mean}
        return shown


MOST_POINTS = 2000


class Series:
    """The changes of a tag or variable over the horizon: (seconds from the start, value); None while it has no good value.

    It holds at most `MOST_POINTS` changes. When there are more, changes that follow each other closely are merged.
    """

    def __init__(self, horizon_s: float) -> None:
        self.points: list[tuple[float, float | None]] = []
        self._horizon_s = horizon_s
        self._least_s = 0.0

    def saw(self, t_s: float, value: Any, good: bool) -> None:
        """Record a value."""
        number = float(value) if good and isinstance(value, int | float) and math.isfinite(value) else None
        if self.points and self.points[-1][1] == number:
            return
        if self.points and t_s - self.points[-1][0] < self._least_s:
            self.points[-1] = (self.points[-1][0], number)
            return
        self.points.append((t_s, number))
        if len(self.points) >= MOST_POINTS:
            self.points = self.points[::2]
            self._least_s = max(2 * self._least_s, 2 * self._horizon_s / MOST_POINTS)

    def described(self) -> list[list[float | None]]:
        return [[round(t_s, 3), value] for t_s, value in self.points]


@dataclass(slots=True)
class Requirement:
    """A requirement of a plan and whether it held. `kind` is ``require`` or ``finally``.

    `broken_s` is the time at which it first did not hold, None while it holds; `seen` are the values at that time.
    """

    kind: str
    text: str
    broken_s: float | None = None
    seen: str = ""

    def described(self) -> dict[str, Any]:
        return {
            "kind": self.kind,
            "text": self.text,
            "met": self.broken_s is None,
            "at_s": self.broken_s,
            "seen": self.seen,
        }


@dataclass
class PlanOutcome:
    """The outcome of one plan.

    `error` is the reason why the outcome is missing. `not_taken` names devices and programs that could not start from their
    known state.
    """

    plan: str
    horizon_s: float = 0.0
    variables: dict[str, VariableOutcome] = field(default_factory=dict)
    requirements: list[Requirement] = field(default_factory=list)
    not_taken: list[str] = field(default_factory=list)
    states: dict[str, list[tuple[float, str]]] = field(default_factory=dict)
    series: dict[str, Series] = field(default_factory=dict)
    """The tags and variables whose values over time are wanted."""
    started_ns: int = 0
    """The start of the horizon on the fork's monotonic clock."""
    error: str = ""
    took_s: float = 0.0

    @property
    def met(self) -> bool:
        return not self.error and all(r.broken_s is None for r in self.requirements)

    def saw_tag(self, name: str, value: TagValue) -> None:
        """Record a published tag."""
        good = value.quality is not Quality.BAD
        self._of(name).saw(value.value, good, value.t_ns)
        self._follow(name, value.value, good, value.t_ns)

    def saw_variable(self, name: str, value: Any, t_ns: int) -> None:
        """Record a program's change of a variable."""
        self._of(name).saw(value, True, t_ns)
        self._follow(name, value, True, t_ns)

    def ends(self, t_ns: int) -> None:
        """End the statistics at the horizon."""
        for variable in self.variables.values():
            variable.ends(t_ns)

    def _follow(self, name: str, value: Any, good: bool, t_ns: int) -> None:
        series = self.series.get(name)
        if series is not None:
            series.saw(max(0.0, (t_ns - self.started_ns) / NS_PER_S), value, good)

    def _of(self, name: str) -> VariableOutcome:
        found = self.variables.get(name)
        if found is None:
            found = self.variables[name] = VariableOutcome()
        return found

    def described(self) -> dict[str, Any]:
        """Return JSON data, which is the same for every run of the same fork, except for `took_s`."""
        series = {"series": {name: s.described() for name, s in self.series.items()}} if self.series else {}
        return {
            "plan": self.plan,
            "met": self.met,
            "error": self.error,
            "horizon_s": self.horizon_s,
            "requirements": [r.described() for r in self.requirements],
            "states": {p: [[round(t, 3), s] for t, s in seen] for p, seen in self.states.items()},
            "variables": {name: v.described() for name, v in sorted(self.variables.items())},
            **series,
            "not_taken": self.not_taken,
            "took_s": round(self.took_s, 3),
        }


def _shown(value: Any) -> Any:
    if isinstance(value, bytes):
        return value.hex()
    return None if isinstance(value, float) and math.isnan(value) else value
