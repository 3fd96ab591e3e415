"""The rules of a scenario for the whole run: sequences in time, rates, cycles. They are checked at each check of the runner.

This module performs no I/O: the caller passes the time, the trace's events and a function `look` that returns known values. The
module reports broken rules; the caller decides whether a broken rule ends the run.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any

from fieldtwin.emulators.faults.schema import seconds
from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.conditions.expression import Expression, Look
from fieldtwin.results.model import CheckResult, Verdict
from fieldtwin.results.trace import TraceEvent, TraceKind
from fieldtwin.scenarios.bench import Bench
from fieldtwin.scenarios.judging.expectation import bounds_text, inside
from fieldtwin.scenarios.judging.knowledge import Knowledge
from fieldtwin.scenarios.judging.lateness import allowance
from fieldtwin.scenarios.judging.violation import Violation
from fieldtwin.scenarios.language.form import Scenario
from fieldtwin.scenarios.language.invariants import Followed, Invariants
from fieldtwin.scenarios.language.words import Cycle, Rate

SAMPLES = 500
"""Number of samples that the rule of a rate stores for one window; it determines how finely the window moves."""


class WholeRun:
    """The rules `within`, `rate` and `cycle` of one scenario. `look` returns the first that is broken now.

    `results` is called once, at the end.
    """

    def __init__(
        self, scenario: Scenario, bench: Bench, knowledge: Knowledge, invariants: Invariants, *, by_chance: bool = False
    ) -> None:
        form = scenario.form
        self.requests: Counter[str] = Counter()
        """The number of exchanges by device; the runner increases it."""
        self.withins = [
            WithinRule(
                f"within {n}",
                scenario.line("within", n - 1),
                scenario.expression(one.after, "within", n - 1, "after"),
                scenario.expression(one.then, "within", n - 1, "then"),
                seconds(one.within),
            )
            for n, one in enumerate(form.within, 1)
        ] + [within_rule(followed) for followed in invariants.followed]
        self._rates = [
            _Rate(
                f"rate {n}",
                scenario.line("rate", n - 1),
                one,
                seconds(one.over),
                _condition(scenario, one, "rate", n - 1),
            )
            for n, one in enumerate(form.rate, 1)
        ]
        self._cycles = [
            _Cycle(f"cycle {n}", scenario.line("cycle", n - 1), one, _condition(scenario, one, "cycle", n - 1))
            for n, one in enumerate(form.cycle, 1)
        ]
        if by_chance:  # rates and cycles do not apply to a system with random faults
            self._rates, self._cycles = [], []
        self._bench = bench
        self._knowledge = knowledge

    def hear(self, event: TraceEvent) -> None:
        """Process an event of the trace."""
        for cycle in self._cycles:
            cycle.hear(event)

    @property
    def pending_until_s(self) -> float:
        """Return the time (s) until which the run must continue so that every `within` is decided; 0 if none is pending."""
        return max((one.due_s for one in self.withins if one.due_s is not None), default=0.0)

    def look(self) -> Violation | None:
        """Return the first rule that is broken now."""
        said = self._first_broken(self._bench.now_s(), self._knowledge.look)
        if said is None or not (known := self._knowledge.of(said.names)):
            return said
        return replace(said, got=f"{said.got}; {known}")

    def _first_broken(self, now_s: float, look: Look) -> Violation | None:
        for within in self.withins:
            if (said := within.look(now_s, look, self._bench)) is not None:
                return said
        for rate in self._rates:
            if (said := rate.look(now_s, look, self._count(rate.form))) is not None:
                return said
        for cycle in self._cycles:
            if (said := cycle.look(now_s, look, self._bench)) is not None:
                return said
        return None

    def _count(self, form: Rate) -> int:
        if form.wire is not None:
            return self.requests[form.wire]
        reading = self._bench.reading(form.tag or "")
        return reading.updates if reading is not None else 0

    def results(self, now_ns: int) -> Iterator[CheckResult]:
        """Yield a result for each rule, in the order of the file. A rule that never checked anything is INCONCLUSIVE."""
        rules: list[WithinRule | _Rate | _Cycle] = [*self.withins, *self._rates, *self._cycles]
        for rule in rules:
            got, known = rule.summary()
            verdict, vacuous = Verdict.PASSED if known else Verdict.INCONCLUSIVE, False
            if isinstance(rule, WithinRule):
                vacuous = rule.never_came
                if (
                    vacuous and rule.invariant and rule.known
                ):  # an invariant applies to every run, and in most runs `after` never becomes true
                    verdict = Verdict.PASSED
            yield CheckResult(
                rule.number, rule.text, verdict, now_ns, 0, got=got, where=rule.where, names=rule.names, vacuous=vacuous
            )


def _condition(scenario: Scenario, form: Rate | Cycle, word: str, n: int) -> Expression | None:
    return scenario.expression(form.while_, word, n, "while") if form.while_ is not None else None


def within_rule(followed: Followed) -> WithinRule:
    """Return the rule that checks an invariant of the system file."""
    return WithinRule(followed.number, followed.where, followed.after, followed.then, followed.limit_s, invariant=True)


@dataclass
class WithinRule:
    """The rule that `then` becomes true within `limit_s` of each time that `after` becomes true.

    `then` must be seen to be true in time: unknown is not enough. If `after` was unknown for a while after it was
    known, an occasion may have been missed, and the rule is INCONCLUSIVE.
    """

    number: str
    where: str
    after: Expression
    then: Expression
    limit_s: float
    invariant: bool = False
    """Whether the rule is an invariant of the system file, not a rule of the scenario."""
    times: int = 0
    due_s: float | None = None
    _before: bool | None = None
    _since_s: float = 0.0
    _known: bool = False
    _unknown_s: float | None = None

    @property
    def never_came(self) -> bool:
        """Return whether `after` never became true. The result is False if `after` was unknown for a while after it had been
        known."""
        return not self.times and self._unknown_s is None

    @property
    def known(self) -> bool:
        """Return whether the value of `after` was ever known."""
        return self._known

    @property
    def text(self) -> str:
        return f"{self.then.text} within {self.limit_s:g} s after {self.after.text}"

    @property
    def names(self) -> tuple[str, ...]:
        return (*self.after.names, *self.then.names)

    def look(self, now_s: float, look: Look, bench: Bench) -> Violation | None:
        truth = self.after.truth(look)
        self._known |= truth is not None
        if self._known and truth is None and self._unknown_s is None:
            self._unknown_s = now_s
        if truth and not self._before and self.due_s is None:
            self.times += 1
            self._since_s, self.due_s = now_s, now_s + self.limit_s
        self._before = truth
        if self.due_s is None:
            return None
        then = self.then.truth(look)
        allowed = allowance(bench, self._since_s, self.limit_s, (self.after, self.then))
        self.due_s = self._since_s + self.limit_s + allowed.any_s
        if then:
            self.due_s = None
            if not allowed.in_time(now_s - self._since_s):
                got = f"so {now_s - self._since_s:.3f} s after it; this host itself was late for {allowed.own_s:.3f} s"
                return Violation(
                    self.number, self.text, got, self.names, self.limit_s, self._since_s, self.where, undecidable=True
                )
        elif now_s >= self.due_s:
            state = "was unknown at" if then is None else "did not hold until"
            got = f"the first condition became true at {self._since_s:.3f} s, and the second {state} {now_s:.3f} s"
            bound_s = 0.0 if allowed.applies and not allowed.exhausted else self.limit_s
            if allowed.any_s:
                got += f", {allowed.any_s:.3f} s of that for the lateness of this host"
            return Violation(self.number, self.text, got, self.names, bound_s, self._since_s, self.where)
        return None

    def summary(self) -> tuple[str, bool]:
        """Return what was observed, as text, and whether that was enough for a verdict."""
        seen = f"{self.times} times" if self.times else "0 times: nothing to check"
        if self._unknown_s is not None:
            return f"{seen}; whether {self.after.text} was unknown from {self._unknown_s:.3f} s on for a while", False
        return seen, self.times > 0


@dataclass
class _Rate:
    """A rate per second that must hold in every period of `over_s` in which the condition was true all the time."""

    number: str
    where: str
    form: Rate
    over_s: float
    condition: Expression | None
    judged: int = 0
    seen: bool = False
    """Whether the tag was ever published, or the device ever polled: otherwise a rate of 0 proves nothing."""
    _samples: deque[tuple[float, int]] = field(default_factory=lambda: deque(maxlen=SAMPLES * 2))

    @property
    def text(self) -> str:
        what = f"updates/s of {self.form.tag}" if self.form.tag else f"requests/s to {self.form.wire}"
        return f"{bounds_text(self._bounds)} {what} over {self.over_s:g} s"

    @property
    def _bounds(self) -> Any:
        return self.form.updates_per_s or self.form.requests_per_s

    def look(self, now_s: float, look: Look, count: int) -> Violation | None:
        self.seen |= count > 0
        if self.condition is not None and self.condition.truth(look) is not True:
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
        got = f"{rate:.3g}/s: {count - before} from {since_s:.3f} s to {now_s:.3f} s"
        return Violation(self.number, self.text, got, self.names, self.over_s, since_s, self.where)

    @property
    def names(self) -> tuple[str, ...]:
        return (self.form.tag or self.form.wire or "",)

    def summary(self) -> tuple[str, bool]:
        """Return what was observed, as text, and whether that was enough for a verdict."""
        if not self.judged:
            return "0 checks: nothing to check", False
        if not self.seen:
            what = "was never published" if self.form.tag else "was never polled"
            return f"{self.judged} looks, but {self.names[0]} {what}", False
        return f"{self.judged} looks", True


class _Cycle:
    """The limits for the time between changes of a tag or variable, or for the lateness of scans."""

    def __init__(self, number: str, where: str, form: Cycle, condition: Expression | None) -> None:
        self.number = number
        self.where = where
        self.form = form
        self.judged = 0
        self._condition = condition
        self._min_s = seconds(form.min) if form.min is not None else None
        self._max_s = seconds(form.max) if form.max is not None else None
        self._late_s = seconds(form.late) if form.late is not None else None
        self._value: Any = None
        self._last_s: float | None = None
        self._read = False
        """Whether the name is a tag that was read from its device."""
        self._between: deque[tuple[float, float]] = deque(maxlen=10_000)

    @property
    def text(self) -> str:
        if self._late_s is not None:
            return f"scans at most {self._late_s * 1000:g} ms late"
        parts = [f"at least {self._min_s:g} s"] if self._min_s is not None else []
        parts += [f"at most {self._max_s:g} s"] if self._max_s is not None else []
        return f"changes of {self.form.changes_of} {' and '.join(parts)} apart"

    def hear(self, event: TraceEvent) -> None:
        if event.where != self.form.changes_of or event.kind not in (TraceKind.TAG, TraceKind.STATE, TraceKind.ALARM):
            return
        # After the first read, only values that were read count; commanded values do not.
        if event.kind is TraceKind.TAG and not self._read:
            self._read, self._value, self._last_s = True, None, None
            self._between.clear()
        elif event.kind is TraceKind.STATE and self._read:
            return
        value = event.data.get("value")
        if value is None or value != value:  # an unknown value is a gap, not a change
            self._value = self._last_s = None
            return
        if value == self._value:
            return
        known, self._value = self._value is not None, value
        at_s = event.t_ns / NS_PER_S
        if known and self._last_s is not None:
            self._between.append((self._last_s, at_s))
        self._last_s = at_s if known else None

    def look(self, now_s: float, look: Look, bench: Bench) -> Violation | None:
        if self._condition is not None and self._condition.truth(look) is not True:
            self._last_s = None
            self._between.clear()
            return None
        if self._late_s is not None:
            self.judged += 1
            late_s = bench.late_ms() / 1000
            if late_s <= self._late_s:
                return None
            return self._broken(f"{late_s * 1000:g} ms late at {now_s:.3f} s", now_s)
        while self._between:
            since_s, at_s = self._between.popleft()
            self.judged += 1
            apart_s = at_s - since_s
            if (self._min_s is not None and apart_s < self._min_s) or (
                self._max_s is not None and apart_s > self._max_s
            ):
                return self._broken(f"{apart_s:.3f} s, from {since_s:.3f} s to {at_s:.3f} s", since_s)
        if self._max_s is not None and self._last_s is not None and now_s - self._last_s > self._max_s:
            return self._broken(f"none from {self._last_s:.3f} s to {now_s:.3f} s", self._last_s)
        return None

    @property
    def names(self) -> tuple[str, ...]:
        return ("plc.late",) if self.form.changes_of is None else (self.form.changes_of,)

    def _broken(self, got: str, since_s: float) -> Violation:
        bound_s = self._late_s or self._max_s or self._min_s or 0.0
        late = self._late_s is not None
        return Violation(self.number, self.text, got, self.names, bound_s, since_s, self.where, asks_lateness=late)

    def summary(self) -> tuple[str, bool]:
        """Return what was observed, as text, and whether that was enough for a verdict."""
        unit = "looks" if self._late_s is not None else "changes"
        return f"{self.judged} {unit}{'' if self.judged else ': nothing to check'}", self.judged > 0
