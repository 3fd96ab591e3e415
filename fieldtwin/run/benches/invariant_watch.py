"""Check the invariants of a system file during a run and report them in its summary. A broken invariant makes the run fail."""

from __future__ import annotations

from typing import Any

from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.results.model import Verdict
from fieldtwin.scenarios.bench import Bench
from fieldtwin.scenarios.judging.knowledge import Knowledge
from fieldtwin.scenarios.judging.runner import LATE_SHARE, RECENT_S
from fieldtwin.scenarios.judging.standing import AlwaysRule, always_rule
from fieldtwin.scenarios.judging.whole_run import WithinRule, within_rule
from fieldtwin.scenarios.language.names import invariants_of, names_of
from fieldtwin.twin.site.system import System

Rule = AlwaysRule | WithinRule


class InvariantWatch:
    """The invariants of `system`. `run` checks them until it is cancelled; `results` and `errors` are valid at any time.

    Each invariant is checked until it is broken for the first time. Raises `FileInvalid` for an invalid invariant.
    """

    def __init__(self, system: System) -> None:
        self._system = system
        stated = invariants_of(system)
        self.names = sorted(stated.names)
        """The tags and variables that the invariants use."""
        self._rules: list[Rule] = [*map(always_rule, stated.stated), *map(within_rule, stated.followed)]
        self._broken: dict[str, tuple[Verdict, str, float]] = {}
        """For each broken rule: the verdict, the explanation, and the time in seconds of the run at which it was broken."""
        self._ended = ""
        self._now_s = 0.0

    def __bool__(self) -> bool:
        return bool(self._rules)

    async def run(self, bench: Bench, every_s: float) -> None:
        """Check every `every_s` seconds of the run. Raises the bench's errors."""
        knowledge = Knowledge(self._system, names_of(self._system), bench)
        bench.trace.listen(knowledge.hear)
        while True:
            self._look(bench.now_s(), knowledge, bench)
            await bench.sleep_until_s(bench.now_s() + every_s)

    def end(self, why: str) -> None:
        """Stop checking, for the reason `why`."""
        self._ended = f"; not checked from {self._now_s:.3f} s on: {why}"

    def _look(self, now_s: float, knowledge: Knowledge, bench: Bench) -> None:
        self._now_s = now_s
        for rule in self._rules:
            if rule.number in self._broken:
                continue
            if isinstance(rule, AlwaysRule):
                said = rule.look(now_s, knowledge)
            else:
                said = rule.look(now_s, knowledge.look, bench)
            if said is not None:
                late_s = bench.host_late_s(now_s - said.bound_s - RECENT_S)
                unknown = said.undecidable or (said.bound_s > 0 and late_s > LATE_SHARE * said.bound_s)
                verdict = Verdict.INCONCLUSIVE if unknown else Verdict.FAILED
                late = f"; but this host itself was {late_s * 1000:.0f} ms late" if unknown else ""
                self._broken[rule.number] = verdict, f"broken at {now_s:.3f} s: {said.got}{late}", now_s

    def results(self) -> list[dict[str, Any]]:
        """Return each invariant with its verdict, as plain data: passed, failed, or inconclusive if its value was not known."""
        return [self._result(rule) for rule in self._rules]

    def _result(self, rule: Rule) -> dict[str, Any]:
        broken_s = None
        text = rule.text if isinstance(rule, WithinRule) else rule.expression.text
        if rule.number in self._broken:
            verdict, got, broken_s = self._broken[rule.number]
        elif isinstance(rule, WithinRule):
            got, judged = rule.summary()
            verdict = Verdict.PASSED if judged or (rule.never_came and rule.known) else Verdict.INCONCLUSIVE
        else:
            told = rule.result(round(self._now_s * NS_PER_S), {})
            verdict, got = told.verdict, told.got
        return {
            "number": rule.number,
            "text": text,
            "verdict": verdict.value,
            "got": got + self._ended,
            "broken_s": broken_s,
            "where": rule.where,
        }

    def errors(self) -> list[str]:
        """Return a line for each invariant that was broken."""
        return [
            f"{one['number']}: {one['text']}: {one['got']} ({one['where']})"
            for one in self.results()
            if one["verdict"] == Verdict.FAILED.value
        ]
