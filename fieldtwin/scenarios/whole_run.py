"""What a scenario wants of the whole run: one thing after another in time, rates, cycles. Looked at whenever the runner looks.

Pure: it is told the time, asks `look` what is known, and hears the trace's events. What is broken it says; who that ends is not
its business.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

from emulators.faults.schema import seconds
from fieldtwin.scenarios.bench import Bench
from fieldtwin.scenarios.expectation import bounds_text, inside
from fieldtwin.scenarios.expression import Expression, Look
from fieldtwin.scenarios.form import Scenario
from fieldtwin.scenarios.trace import Event, Kind
from fieldtwin.scenarios.words import Cycle, Rate

SAMPLES = 500
"""Looks that a rate remembers: its windows begin that much apart at most."""
_NS = 1_000_000_000


@dataclass(frozen=True)
class Violation:
    """What did not hold. `bound_s` is the time that it is about: a host that is later than a part of it proves nothing."""

    number: str
    expected: str
    got: str
    names: tuple[str, ...]
    bound_s: float


class WholeRun:
    """All of them, of one scenario. `look()` returns the first that is broken now; `summary()` tells what held."""

    def __init__(self, scenario: Scenario, bench: Bench, look: Look) -> None:
        form = scenario.form
        self.requests: Counter[str] = Counter()
        """Exchanges by device, as the runner counts them."""
        self.withins = [
            _Within(
                f"within {n}",
                scenario.expression(one.after, "within", n - 1, "after"),
                scenario.expression(one.then, "within", n - 1, "then"),
                seconds(one.within),
            )
            for n, one in enumerate(form.within, 1)
        ]
        self._rates = [
            _Rate(f"rate {n}", one, seconds(one.over), _condition(scenario, one, "rate", n - 1))
            for n, one in enumerate(form.rate, 1)
        ]
        self._cycles = [
            _Cycle(f"cycle {n}", one, _condition(scenario, one, "cycle", n - 1)) for n, one in enumerate(form.cycle, 1)
        ]
        self._bench = bench
        self._look = look

    def hear(self, event: Event) -> None:
        """An event of the trace."""
        for cycle in self._cycles:
            cycle.hear(event)

    @property
    def pending_until_s(self) -> float:
        """Until when the run must go on for every `within` to be decided; 0 when none is open."""
        return max((one.due_s for one in self.withins if one.due_s is not None), default=0.0)

    def look(self) -> Violation | None:
        now_s = self._bench.now_s()
        for within in self.withins:
            if (said := within.look(now_s, self._look)) is not None:
                return said
        for rate in self._rates:
            if (said := rate.look(now_s, self._look, self._count(rate.form))) is not None:
                return said
        for cycle in self._cycles:
            if (said := cycle.look(now_s, self._look, self._bench)) is not None:
                return said
        return None

    def _count(self, form: Rate) -> int:
        if form.wire is not None:
            return self.requests[form.wire]
        reading = self._bench.reading(form.tag or "")
        return reading.updates if reading is not None else 0

    def summary(self) -> Iterator[tuple[str, str, str, bool]]:
        """(number, text, what was seen, whether anything was) of each."""
        for within in self.withins:
            yield within.number, within.text, f"{within.times} times", within.times > 0
        for rate in self._rates:
            yield rate.number, rate.text, f"{rate.judged} looks", rate.judged > 0
        for cycle in self._cycles:
            yield cycle.number, cycle.text, f"{cycle.judged} looks", cycle.judged > 0


def _condition(scenario: Scenario, form: Rate | Cycle, word: str, n: int) -> Expression | None:
    return scenario.expression(form.while_, word, n, "while") if form.while_ is not None else None


@dataclass
class _Within:
    """`then` within `limit_s` of each time that `after` becomes true."""

    number: str
    after: Expression
    then: Expression
    limit_s: float
    times: int = 0
    due_s: float | None = None
    _was: bool = False
    _since_s: float = 0.0

    @property
    def text(self) -> str:
        return f"{self.then.text} within {self.limit_s:g} s after {self.after.text}"

    def look(self, now_s: float, look: Look) -> Violation | None:
        is_so = bool(self.after.evaluate(look))
        if is_so and not self._was and self.due_s is None:
            self.times += 1
            self._since_s, self.due_s = now_s, now_s + self.limit_s
        self._was = is_so
        if self.due_s is None:
            return None
        if self.then.evaluate(look):
            self.due_s = None
        elif now_s >= self.due_s:
            got = f"that was at {self._since_s:.3f} s, and not so until {now_s:.3f} s"
            return Violation(self.number, self.text, got, (*self.after.names, *self.then.names), self.limit_s)
        return None


@dataclass
class _Rate:
    """So often a second, in every stretch of `over_s` in which the condition held all the time."""

    number: str
    form: Rate
    over_s: float
    condition: Expression | None
    judged: int = 0
    _samples: deque[tuple[float, int]] = field(default_factory=lambda: deque(maxlen=SAMPLES * 2))

    @property
    def text(self) -> str:
        what = f"updates/s of {self.form.tag}" if self.form.tag else f"requests/s to {self.form.wire}"
        return f"{bounds_text(self._bounds)} {what} over {self.over_s:g} s"

    @property
    def _bounds(self) -> Any:
        return self.form.updates_per_s or self.form.requests_per_s

    def look(self, now_s: float, look: Look, count: int) -> Violation | None:
        if self.condition is not None and not self.condition.evaluate(look):
            self._samples.clear()
            return None
        samples = self._samples
        if not samples or now_s - samples[-1][0] >= self.over_s / SAMPLES:
            samples.append((now_s, count))
        while len(samples) > 1 and now_s - samples[1][0] >= self.over_s:
            samples.popleft()
        since_s, before = samples[0]
        if now_s - since_s < self.over_s:
            return None
        self.judged += 1
        rate = (count - before) / (now_s - since_s)
        if inside(rate, self._bounds):
            return None
        name = self.form.tag or self.form.wire or ""
        got = f"{rate:.3g}/s: {count - before} from {since_s:.3f} s to {now_s:.3f} s"
        return Violation(self.number, self.text, got, (name,), self.over_s)


class _Cycle:
    """Changes of a name so far apart; or scans so late at most."""

    def __init__(self, number: str, form: Cycle, condition: Expression | None) -> None:
        self.number = number
        self.form = form
        self.judged = 0
        self._condition = condition
        self._min_s = seconds(form.min) if form.min is not None else None
        self._max_s = seconds(form.max) if form.max is not None else None
        self._late_s = seconds(form.late) if form.late is not None else None
        self._value: Any = None
        self._last_s: float | None = None
        self._between: deque[tuple[float, float]] = deque(maxlen=10_000)

    @property
    def text(self) -> str:
        if self._late_s is not None:
            return f"scans at most {self._late_s * 1000:g} ms late"
        parts = [f"at least {self._min_s:g} s"] if self._min_s is not None else []
        parts += [f"at most {self._max_s:g} s"] if self._max_s is not None else []
        return f"changes of {self.form.changes_of} {' and '.join(parts)} apart"

    def hear(self, event: Event) -> None:
        if event.where != self.form.changes_of or event.kind not in (Kind.TAG, Kind.STATE):
            return
        value = event.data.get("value")
        if value == self._value:
            return
        known, self._value = self._value is not None, value
        at_s = event.t_ns / _NS
        if known and self._last_s is not None:
            self._between.append((self._last_s, at_s))
        self._last_s = at_s if known else None

    def look(self, now_s: float, look: Look, bench: Bench) -> Violation | None:
        if self._condition is not None and not self._condition.evaluate(look):
            self._last_s = None
            self._between.clear()
            return None
        if self._late_s is not None:
            self.judged += 1
            late_s = bench.late_ms() / 1000
            return (
                None
                if late_s <= self._late_s
                else self._said(f"{late_s * 1000:g} ms late at {now_s:.3f} s", ("plc.late",))
            )
        while self._between:
            since_s, at_s = self._between.popleft()
            self.judged += 1
            apart_s = at_s - since_s
            if (self._min_s is not None and apart_s < self._min_s) or (
                self._max_s is not None and apart_s > self._max_s
            ):
                return self._said(f"{apart_s:.3f} s, from {since_s:.3f} s to {at_s:.3f} s")
        if self._max_s is not None and self._last_s is not None and now_s - self._last_s > self._max_s:
            return self._said(f"none from {self._last_s:.3f} s to {now_s:.3f} s")
        return None

    def _said(self, got: str, names: tuple[str, ...] = ()) -> Violation:
        bound_s = self._late_s or self._max_s or self._min_s or 0.0
        return Violation(self.number, self.text, got, names or (self.form.changes_of or "",), bound_s)
