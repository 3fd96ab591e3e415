"""The rules of a scenario for the whole run: `always`, `never`, and that every part of the system runs.

These rules are checked at each check of the runner. A rule whose value is unknown is neither fulfilled nor broken: a rule that
was never known, or was unknown for a while after it was known, is INCONCLUSIVE at the end.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

from fieldtwin.capture.decoding.exchange import DecodedExchange
from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.conditions.expression import Expression
from fieldtwin.results.model import CheckResult, Verdict
from fieldtwin.scenarios.bench import Bench, Part
from fieldtwin.scenarios.judging.expectation import said, wire_matches
from fieldtwin.scenarios.judging.knowledge import Knowledge
from fieldtwin.scenarios.judging.violation import Violation
from fieldtwin.scenarios.language.form import Scenario
from fieldtwin.scenarios.language.invariants import Invariants, Stated
from fieldtwin.scenarios.language.words import WireForm


class Standing:
    """The rules `always` and `never` of one scenario, and the rule that every part of the system runs.

    `look` returns the first rule that is broken now; `results` is called once, at the end.
    """

    def __init__(self, scenario: Scenario, bench: Bench, knowledge: Knowledge, invariants: Invariants) -> None:
        form = scenario.form
        self._bench = bench
        self._knowledge = knowledge
        self._expressions: list[AlwaysRule] = []
        self._wires: list[_NeverOnWire] = []
        self._running = _Running(bench, tuple(form.stopped), scenario.line("stopped"))
        for n, expression in enumerate(scenario.always):
            self._expressions.append(AlwaysRule(f"always {n + 1}", expression, True, scenario.line("always", n)))
        for n, one in enumerate(scenario.never):
            number, where = f"never {n + 1}", scenario.line("never", n)
            if isinstance(one, Expression):
                self._expressions.append(AlwaysRule(number, one, False, where))
            else:
                unless = scenario.expression(one.unless, "never", n, "unless") if one.unless is not None else None
                self._wires.append(_NeverOnWire(number, one, unless, where))
        self._expressions += [always_rule(stated) for stated in invariants.stated]

    def saw(self, exchange: DecodedExchange) -> None:
        """Record an exchange that was seen on a device's bus."""
        for rule in self._wires:
            rule.watched.append(exchange)

    def look(self) -> Violation | None:
        """Return the first rule that is broken now."""
        now_s = self._bench.now_s()
        if (broken := self._running.look(now_s)) is not None:
            return broken
        for rule in self._expressions:
            if (broken := rule.look(now_s, self._knowledge)) is not None:
                return broken
        for one in self._wires:
            if (broken := one.look(now_s, self._knowledge)) is not None:
                return broken
        return None

    def results(self, now_ns: int, requests: Counter[str]) -> Iterator[CheckResult]:
        """Yield a result for each rule, in the order of the file. `requests`: the number of exchanges seen, by device."""
        if (part := self._running.result(now_ns)) is not None:
            yield part
        rules: Sequence[AlwaysRule | _NeverOnWire] = [*self._expressions, *self._wires]
        for rule in sorted(rules, key=_place):
            yield rule.result(now_ns, requests)


@dataclass
class AlwaysRule:
    """The rule that an expression is always (`wanted` True) or never (False) true, as soon as all its names have been read."""

    number: str
    expression: Expression
    wanted: bool
    where: str
    since_s: float | None = None
    """Time (s) from which the rule was checked."""
    looks: int = 0
    unknown_s: float | None = None
    """The time (s) at which the expression became unknown for the first time after it was known."""
    unknown_looks: int = 0

    def look(self, now_s: float, knowledge: Knowledge) -> Violation | None:
        truth = self.expression.truth(knowledge.look)
        if self.since_s is None:
            if truth is None or not knowledge.all_read(self.expression):
                return None
            self.since_s = now_s
        if truth is None:
            self.unknown_looks += 1
            self.unknown_s = now_s if self.unknown_s is None else self.unknown_s
            return None
        self.looks += 1
        if truth is self.wanted:
            return None
        return Violation(
            self.number,
            self.expression.text,
            knowledge.of_expression(self.expression),
            tuple(self.expression.names),
            min(self.expression.times_s, default=0.0),
            now_s,
            self.where,
            asks_lateness=self.expression.asks_lateness,
        )

    def result(self, now_ns: int, requests: Mapping[str, int]) -> CheckResult:
        names, verdict = tuple(self.expression.names), Verdict.PASSED
        vacuous = self.since_s is None
        if vacuous:
            verdict, got = Verdict.INCONCLUSIVE, f"there was never a value of {', '.join(dict.fromkeys(names))}"
        else:
            got = f"{self.looks} checks from {self.since_s:.3f} s on"
        if self.unknown_s is not None:
            verdict = Verdict.INCONCLUSIVE
            got += f"; no value in {self.unknown_looks} checks, first at {self.unknown_s:.3f} s"
        since_ns = round((self.since_s or 0.0) * NS_PER_S)
        return CheckResult(
            self.number,
            self.expression.text,
            verdict,
            now_ns,
            since_ns,
            got=got,
            where=self.where,
            names=names,
            vacuous=vacuous,
        )


def always_rule(stated: Stated) -> AlwaysRule:
    """Return the rule that checks an invariant of the system file."""
    return AlwaysRule(stated.number, stated.expression, stated.wanted, stated.where)


@dataclass
class _NeverOnWire:
    """The rule that an exchange is never seen on a device's bus, unless the expression `unless` is true at that time."""

    number: str
    form: WireForm
    unless: Expression | None
    where: str
    watched: deque[DecodedExchange] = field(default_factory=deque)
    """The exchanges seen since the last check."""
    _excused: bool = False

    def look(self, now_s: float, knowledge: Knowledge) -> Violation | None:
        # An exchange may have ended before this check: `unless` counts if it is known to be true now or was at the previous
        # check.
        now = self.unless is not None and self.unless.truth(knowledge.look) is True
        excused, self._excused = now or self._excused, now
        while self.watched:
            exchange = self.watched.popleft()
            if not excused and exchange.device == self.form.wire and wire_matches(self.form, exchange):
                seen_s = exchange.t_ns / NS_PER_S
                return Violation(
                    self.number, said(self.form), exchange.text, (self.form.wire,), 0.0, seen_s, self.where
                )
        return None

    def result(self, now_ns: int, requests: Counter[str]) -> CheckResult:
        seen = requests[self.form.wire]
        got = f"{seen} exchanges seen" if seen else f"no exchange was ever recorded on the bus of {self.form.wire}"
        verdict = Verdict.PASSED if seen else Verdict.INCONCLUSIVE
        return CheckResult(
            self.number,
            said(self.form),
            verdict,
            now_ns,
            0,
            got=got,
            where=self.where,
            names=(self.form.wire,),
            vacuous=not seen,
        )


class _Running:
    """The rule that every part of the system runs, except for those in `stopped:`, which must stop."""

    number = "running"

    def __init__(self, bench: Bench, may_stop: Sequence[Part], where: str) -> None:
        self._bench = bench
        self._may_stop = may_stop
        self._where = where
        self._seen: dict[Part, tuple[float, str]] = {}

    def look(self, now_s: float) -> Violation | None:
        stopped = self._bench.stopped()
        if stopped is None:
            return None
        if stopped.part in self._may_stop:
            self._seen.setdefault(stopped.part, (now_s, stopped.what))
            return None
        text = f"{_NAMES[stopped.part]} runs"
        return Violation(self.number, text, stopped.what, (), stopped.bound_s, now_s, stopped.where)

    def result(self, now_ns: int) -> CheckResult | None:
        """Return the result of the rule; None if the scenario has no `stopped:` and every part ran. A program that never
        started did not run.
        """
        waits = self._bench.not_started()
        if waits and "plc" not in self._may_stop:
            text = f"{_NAMES['plc']} runs"
            return CheckResult(self.number, text, Verdict.FAILED, now_ns, 0, text, waits)
        if not self._may_stop:
            return None
        missing = [part for part in self._may_stop if part not in self._seen]
        told = [f"{_NAMES[part]} stopped at {t_s:.3f} s: {what}" for part, (t_s, what) in self._seen.items()]
        told += [f"{_NAMES[part]} did not stop" for part in missing]
        verdict = Verdict.FAILED if missing else Verdict.PASSED
        text = f"{', '.join(_NAMES[part] for part in self._may_stop)} stops"
        expected = text if missing else ""
        return CheckResult("stopped", text, verdict, now_ns, 0, expected, "; ".join(told), where=self._where)


def _place(rule: AlwaysRule | _NeverOnWire) -> tuple[str, int]:
    word, _, number = rule.number.rpartition(" ")
    return word, int(number)


_NAMES: dict[Part, str] = {"plc": "the PLC", "gateway": "the gateway", "field": "the field simulator"}
