"""Runs a scenario on a bench: step after step, while the rules of the whole run are checked.

A step that fails ends the scenario; the later steps are not reached. The runner does not depend on the target. A step that a
target cannot carry out is SKIPPED. A check that proves nothing because the host was late is INCONCLUSIVE. Neither counts as a
pass.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

from fieldtwin.capture.decoding.decoder import Decoder
from fieldtwin.capture.decoding.exchange import DecodedExchange
from fieldtwin.emulators.faults.schema import seconds
from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.conditions.expression import Expression
from fieldtwin.gateway.core.errors import FieldtwinError, UsageError
from fieldtwin.results.model import CheckResult, ScenarioResult, Struck, Verdict
from fieldtwin.results.trace import TraceEvent, TraceKind
from fieldtwin.scenarios.bench import Bench, Can, NothingKnown
from fieldtwin.scenarios.judging.broken import Broken, RuleBroken, too_late, wanted
from fieldtwin.scenarios.judging.expectation import ExpectationInput, check_exchanges, check_tag, said
from fieldtwin.scenarios.judging.fault_effects import fault_id, without_effect
from fieldtwin.scenarios.judging.knowledge import Knowledge
from fieldtwin.scenarios.judging.last_exchanges import deciding, last_exchanges
from fieldtwin.scenarios.judging.lateness import allowance
from fieldtwin.scenarios.judging.refused import RefusedOutputs
from fieldtwin.scenarios.judging.standing import Standing
from fieldtwin.scenarios.judging.target_limits import refusal
from fieldtwin.scenarios.judging.whole_run import WholeRun
from fieldtwin.scenarios.language.about import result_of
from fieldtwin.scenarios.language.form import Scenario
from fieldtwin.scenarios.language.invariants import Invariants
from fieldtwin.scenarios.language.words import Expect, Step, word_of

TICK_S = 0.02
"""Interval in seconds at which conditions are checked while the runner waits."""
RECENT_S = 2.0
"""Seconds for which lateness of the host can still affect what is checked now."""
KNOWN_WITHIN_S = 5.0
"""Seconds that an expression may take to become known when a step begins to check it: programs have not run yet at the
start.
"""
KEPT = 20_000
LAST_WRITE_S = 0.25
"""Seconds that the gateway may take to write, or to refuse, what the PLC commanded, and to report it."""
LAST_REACTION_MOST_S = 2.0
"""The longest time in seconds for which a scenario continues after its last step, so that the PLC can react to it."""
LATE_SHARE = 0.1
"""If the host was late by more than this fraction of a check's time limit, the check has proved nothing."""


def gone(error: FieldtwinError, t_ns: int) -> CheckResult:
    """Return the result ERROR for a part of the system that failed with `error`, `t_ns` after the run's start."""
    text, where = "every part of the system runs", getattr(error, "place", "")
    return CheckResult("running", text, Verdict.ERROR, t_ns, t_ns, text, str(error), where=where)


def last_reaction_s(scenario: Scenario) -> float:
    """Return how long the rules of the whole run are checked after the last step, in seconds: two scans of the slowest
    task and a write. Otherwise a step that is met immediately would end the scenario before the PLC has reacted, and a
    refusal of the PLC's output would never be seen.
    """
    plc = scenario.system.plc
    cycles_ms = [task.interval_ms for task in plc.tasks.values() if task.interval_ms is not None]
    return min(LAST_REACTION_MOST_S, 2 * max(cycles_ms, default=plc.cycle_ms) / 1000 + LAST_WRITE_S)


@dataclass(frozen=True)
class ByChance:
    """Random faults of a campaign, injected before the first step.

    The steps then only drive the system: their expectations, rates and cycles are not checked. All other rules are checked at
    least until `until_s`, in seconds of the run.
    """

    faults: tuple[dict[str, Any], ...]
    until_s: float


class ScenarioRunner:
    """Runs one scenario on one bench. Call ``await run()`` once."""

    def __init__(self, scenario: Scenario, bench: Bench, by_chance: ByChance | None = None) -> None:
        self.scenario = scenario
        self.bench = bench
        self.results: list[CheckResult] = []
        self.faults: list[Struck] = []
        self.exchanges: deque[DecodedExchange] = deque(maxlen=KEPT)
        self._decoder = Decoder(scenario.system)
        self._dropped = 0
        self._remark = ""
        """A remark on the verdict of the current step."""
        self._stimulus_s = 0.0
        self._by_chance = by_chance
        self._knowledge = Knowledge(scenario.system, scenario.known, bench)
        self._invariants = scenario.invariants if scenario.invariants.names <= set(bench.names()) else Invariants()
        self._standing = Standing(scenario, bench, self._knowledge, self._invariants)
        self._whole = WholeRun(scenario, bench, self._knowledge, self._invariants, by_chance=by_chance is not None)
        self._refused = RefusedOutputs(scenario)
        bench.trace.listen(self._on_event)
        for event in bench.trace.events:  # events from the opening of the bench, before the first step
            if event.kind is TraceKind.REFUSED:
                self._refused.hear(event)

    async def run(self) -> ScenarioResult:
        """Run all steps and return the verdict. If a part of the system has ended, the verdict is ERROR with the reason."""
        scenario = self.scenario
        refused = refusal(scenario, self.bench.target, self.bench.can, self.bench.allowed)
        verdict, reason = Verdict.PASSED, ""
        if refused:
            verdict, reason = Verdict.SKIPPED, refused
        else:
            verdict, reason = await self._judged()
            if verdict is not Verdict.ERROR:  # after an ERROR the system may no longer answer
                verdict, reason = await self._count_faults(verdict, reason)
        return result_of(
            scenario,
            self.bench.target,
            verdict,
            checks=tuple(self.results),
            reason=reason,
            simulated_s=self.bench.now_s(),
            trace=tuple(self.bench.trace.events),
            trace_hash=self.bench.trace.hexdigest(),
            dropped=self.bench.trace.dropped,
            faults=tuple(self.faults),
            evidence=self._evidence(verdict),
        )

    def _evidence(self, verdict: Verdict) -> tuple[str, ...]:
        """Return the exchanges on the bus before the check that gave the scenario its `verdict`; none after a pass or a
        skip.
        """
        check = deciding(self.results, verdict)
        if verdict in (Verdict.PASSED, Verdict.SKIPPED) or check is None:
            return ()
        if self.scenario.group is not None or Can.SEE_WIRE not in self.bench.can:  # no exchange was decoded
            return ()
        seen = [*self.exchanges, *self._decoder.pending()]
        return tuple(last_exchanges(seen, check, self.scenario.system.devices))

    async def _judged(self) -> tuple[Verdict, str]:
        """Run the steps, then the whole-run rules to their end; return the verdict and its reason."""
        try:
            # each of these results contains its own time
            for fault in self._by_chance.faults if self._by_chance is not None else ():
                await self.bench.inject({**fault, "optional": True})
            for n, step in enumerate(self.scenario.form.steps):
                result = await self._step(n, step)
                self.results.append(result)
                if result.verdict is not Verdict.PASSED and not (self._by_chance and result.verdict is Verdict.SKIPPED):
                    return result.verdict, f"step {result.number}: {result.text}"
            if self._by_chance is not None:
                await self._until(self._by_chance.until_s)
            await self._until(self.bench.now_s() + last_reaction_s(self.scenario))
            return await self._hold_to_the_end()
        except RuleBroken as broken:
            self.results.append(broken.rule)
            return broken.rule.verdict, f"{broken.rule.number}: {broken.rule.text}: {broken.rule.got}"
        except NothingKnown as e:
            self.results.append(replace(gone(e, self._now_ns()), verdict=Verdict.INCONCLUSIVE))
            return Verdict.INCONCLUSIVE, str(e)
        except FieldtwinError as e:  # the bench raises this when a part of the system is gone
            self.results.append(gone(e, self._now_ns()))
            return Verdict.ERROR, str(e)

    async def _count_faults(self, verdict: Verdict, reason: str) -> tuple[Verdict, str]:
        """Count the effects of each fault. A scenario that passed although a fault never took effect is INCONCLUSIVE.

        A scenario in which a simulation of devices has failed is an ERROR: a test of a lost device would pass although the
        plant model is broken.
        """
        try:
            failures = await self.bench.failures()
            struck = await self.bench.struck()
            self.faults = [one for one in struck if not one.is_set]
        except FieldtwinError as e:
            self.results.append(gone(e, self._now_ns()))
            return (Verdict.ERROR, str(e)) if verdict is Verdict.PASSED else (verdict, reason)
        for device, why in failures.items():
            text = f"the simulation of {device} runs"
            now_ns = self._now_ns()
            self.results.append(CheckResult(f"simulation {device}", text, Verdict.ERROR, now_ns, now_ns, text, why))
        if failures:
            return Verdict.ERROR, next(iter(failures.values()))
        for result, why in without_effect(self.scenario, struck, self._now_ns()):
            self.results.append(result)
            if verdict is Verdict.PASSED and self._by_chance is None:
                verdict, reason = Verdict.INCONCLUSIVE, why
        return verdict, reason

    # -- steps ----------------------------------------------------------------------------------------------------------

    async def _step(self, n: int, step: Step) -> CheckResult:
        word, since_s = word_of(step), self.bench.now_s()
        text = f"{word}: {said(getattr(step, word))}"
        self.bench.trace.note(self._now_ns(), TraceKind.STEP, str(n + 1), {"text": text})
        expected = got = self._remark = ""
        verdict, rule = Verdict.PASSED, None
        try:
            self._look_at_all()
            await self._do(n, word, step)
            self._look_at_all()
        except Broken as broken:
            verdict, expected, got = self._judged_on_time(broken, since_s)
            if self._by_chance is not None:
                verdict, got = Verdict.SKIPPED, f"not checked under random faults: {got}"
        except RuleBroken as broken_rule:
            rule = broken_rule
            verdict, got = Verdict.INCONCLUSIVE, f"not finished: {rule.rule.number} was violated first"
        except UsageError as e:
            verdict, got = Verdict.ERROR, str(e)
        result = CheckResult(
            str(n + 1),
            text,
            verdict,
            self._now_ns(),
            round(since_s * NS_PER_S),
            expected,
            got,
            where=self.scenario.line("steps", n),
            reason=self._remark,
            names=self._about(n, step),
        )
        self.bench.trace.note(self._now_ns(), TraceKind.STEP, str(n + 1), {"text": text, "verdict": verdict.value})
        if rule is not None:
            self.results.append(result)
            raise rule
        return result

    def _about(self, n: int, step: Step) -> tuple[str, ...]:
        """Return the tags, variables or device that a step checks, whatever its result."""
        if step.wait is not None:
            return tuple(self.scenario.expression(step.wait.until, "steps", n, "wait", "until").names)
        if step.expect is None:
            return ()
        if step.expect.that is not None:
            return tuple(self.scenario.expression(step.expect.that, "steps", n, "expect", "that").names)
        return (step.expect.wire or step.expect.tag or "",)

    def _judged_on_time(self, broken: Broken, since_s: float) -> tuple[Verdict, str, str]:
        """Return the verdict on a broken check.

        If the host was late by more than `LATE_SHARE` of the check's time limit, the verdict is INCONCLUSIVE.
        """
        late_s = self.bench.host_late_s(since_s if broken.since_s is None else broken.since_s)
        if broken.verdict is Verdict.FAILED and broken.bound_s and late_s > LATE_SHARE * broken.bound_s:
            got = f"{broken.got}; but this host itself was {late_s * 1000:.0f} ms late"
            return Verdict.INCONCLUSIVE, broken.expected, got
        return broken.verdict, broken.expected, broken.got

    async def _do(self, n: int, word: str, step: Step) -> None:
        bench = self.bench
        if word in ("send", "set", "fault", "clear"):
            self._stimulus_s = bench.now_s()
        if step.send is not None:
            self._knowledge.commanded()
            await bench.send(step.send.period_s)
        elif step.set is not None:
            device, _, tag = step.set.tag.rpartition(".")
            await bench.set_value(device, tag, self.scenario.system.number_of(step.set.tag, step.set.value))
        elif step.fault is not None:
            await bench.inject({"id": fault_id(n, step), **step.fault})
        elif step.clear is not None:
            await bench.clear(step.clear)
        elif step.acknowledge is not None:
            await bench.acknowledge(step.acknowledge)
        elif step.pause is not None:
            await self._until(bench.now_s() + seconds(step.pause))
        elif step.wait is not None:
            expression = self.scenario.expression(step.wait.until, "steps", n, "wait", "until")
            await self._wait(expression, seconds(step.wait.within))
        elif step.expect is not None:
            await self._expect(n, step.expect)

    async def _wait(self, expression: Expression, within_s: float) -> None:
        since_s = self.bench.now_s()
        unknown_until_s = since_s
        while (truth := expression.truth(self._knowledge.look)) is not True:
            if truth is None:
                unknown_until_s = self.bench.now_s()
            allowed = allowance(self.bench, since_s, within_s, [expression])
            deadline_s = since_s + (max(within_s, KNOWN_WITHIN_S) if truth is None else within_s) + allowed.any_s
            if self.bench.now_s() >= deadline_s:
                waited_s = self.bench.now_s() - since_s
                unknown = f"unknown after {waited_s:g} s: " if truth is None else ""
                got = unknown + self._knowledge.of_expression(expression)
                raise too_late(wanted(expression.text, within_s), got, self._bound(expression, within_s), allowed)
            await self._tick(deadline_s)
        # otherwise the reaction was in time as soon as its value was known
        if self.bench.now_s() - unknown_until_s > TICK_S:
            self._met(wanted(expression.text, within_s), since_s, within_s, [expression])

    def _met(self, expected: str, since_s: float, within_s: float, expressions: Iterable[Expression] = ()) -> None:
        """Accept a check that was met. Raises `Broken` if it took longer than `within_s` plus the host's lateness."""
        took_s = self.bench.now_s() - since_s
        if not within_s or took_s <= within_s:
            return
        allowed = allowance(self.bench, since_s, within_s, expressions)
        late = f"met after {took_s:.3f} s; this host itself was late for {allowed.own_s:.3f} s"
        if not allowed.in_time(took_s):
            got = f"{late}, and {allowed.any_s:.3f} s of total lateness were measured: the host or the system may be the cause"
            raise Broken(Verdict.INCONCLUSIVE, expected, got)
        if allowed.own_s:
            self._remark = f"{late}, which was subtracted"

    async def _expect(self, n: int, expect: Expect) -> None:
        within_s = seconds(expect.within) if expect.within is not None else 0.0
        during_s = seconds(expect.during) if expect.during is not None else 0.0
        if expect.that is not None:
            expression = self.scenario.expression(expect.that, "steps", n, "expect", "that")
            await self._wait(expression, within_s)
            await self._throughout(expression, during_s)
            return
        watched = ExpectationInput(
            self.bench, self.scenario.system, self.bench.now_s(), self._stimulus_s, self.exchanges
        )
        if expect.wire is not None:
            dropped = self._dropped
            await self._until(self.bench.now_s() + max(within_s, during_s))
            if self._dropped != dropped:
                raise Broken(
                    Verdict.INCONCLUSIVE, f"at most {KEPT} exchanges in that time", "more; the oldest were dropped"
                )
            said = check_exchanges(expect, watched)
            if said is not None:
                raise Broken(Verdict.FAILED, *said, max(within_s, during_s))
            # Too few exchanges prove nothing if the bus was never seen working.
            if not self._whole.requests[expect.wire]:
                got = f"no exchange with {expect.wire} was recorded since the start"
                raise Broken(Verdict.INCONCLUSIVE, f"exchanges with {expect.wire}", got)
            return
        assert expect.tag is not None
        if expect.updates_per_s is not None:
            await self._until(self.bench.now_s() + max(during_s, 1.0))
        since_s = self.bench.now_s()
        while (said := await check_tag(expect, watched)) is not None:
            if expect.updates_per_s is not None:
                raise Broken(Verdict.FAILED, *said, max(within_s, during_s))
            allowed = allowance(self.bench, since_s, within_s)
            deadline_s = since_s + within_s + allowed.any_s
            if self.bench.now_s() >= deadline_s:
                raise too_late(*said, max(within_s, during_s), allowed)
            await self._tick(deadline_s)
        self._met(wanted(expect.tag, within_s), since_s, within_s)
        if expect.updates_per_s is None:
            end_s = self.bench.now_s() + during_s
            while self.bench.now_s() < end_s:  # the value must stay so
                await self._tick(end_s)
                if (said := await check_tag(expect, watched)) is not None:
                    raise Broken(Verdict.FAILED, *said, during_s)
            self._looked_all_the_time(end_s - during_s, during_s)

    async def _throughout(self, expression: Expression, during_s: float) -> None:
        end_s = self.bench.now_s() + during_s
        while self.bench.now_s() < end_s:
            await self._tick(end_s)
            if (truth := expression.truth(self._knowledge.look)) is not True:
                got = ("unknown: " if truth is None else "") + self._knowledge.of_expression(expression)
                raise Broken(
                    Verdict.FAILED, f"{expression.text} for {during_s:g} s", got, self._bound(expression, during_s)
                )
        self._looked_all_the_time(end_s - during_s, during_s)

    def _looked_all_the_time(self, since_s: float, during_s: float) -> None:
        """Raise `Broken` if this host was late while a lasting condition had to be checked: the condition may have been false
        for a while.
        """
        late_s = self.bench.host_late_s(since_s)
        if during_s and late_s > LATE_SHARE * during_s:
            raise Broken(
                Verdict.INCONCLUSIVE,
                f"looked at for {during_s:g} s",
                f"this host was {late_s * 1000:.0f} ms late by itself",
            )

    @staticmethod
    def _bound(expression: Expression, limit_s: float = 0.0) -> float:
        """Return the shortest time in a check, in seconds: `limit_s` and the times in the expression; 0 if it has no time."""
        return min([t for t in (limit_s, *expression.times_s) if t > 0], default=0.0)

    # -- time, and what holds all the time --------------------------------------------------------------------------------

    async def _until(self, t_s: float) -> None:
        while self.bench.now_s() < t_s:
            await self._tick(t_s)

    async def _tick(self, at_most_s: float) -> None:
        await self.bench.sleep_until_s(min(self.bench.now_s() + TICK_S, max(at_most_s, self.bench.now_s() + 0.001)))
        self._look_at_all()

    def _look_at_all(self) -> None:
        """Check the rules of the whole run. Raises `RuleBroken`."""
        said = self._standing.look() or self._refused.look() or self._whole.look()
        if said is None:
            return
        verdict = Verdict.INCONCLUSIVE if said.undecidable else self._of_lateness(said.asks_lateness)
        since_s = self.bench.now_s() - said.bound_s - RECENT_S
        broken = Broken(verdict, said.expected, said.got, said.bound_s, since_s)
        verdict, expected, got = self._judged_on_time(broken, since_s)
        since_ns, now_ns = round(said.since_s * NS_PER_S), self._now_ns()
        raise RuleBroken(
            CheckResult(
                said.number,
                said.expected,
                verdict,
                now_ns,
                min(since_ns, now_ns),
                expected,
                got,
                where=said.where,
                names=said.names,
            )
        )

    def _of_lateness(self, asked: bool) -> Verdict:
        """Return the verdict on a check of the lateness of scans: a plant is responsible for its lateness, a host that
        simulates a plant is not.
        """
        ours = asked and Can.EXACT_TIME not in self.bench.can and self.bench.target != "real"
        return Verdict.INCONCLUSIVE if ours else Verdict.FAILED

    async def _hold_to_the_end(self) -> tuple[Verdict, str]:
        """Add a result for each rule of the whole run. A rule that could not be judged makes the scenario INCONCLUSIVE."""
        while self._whole.pending_until_s:
            await self._tick(self._whole.pending_until_s)
        now_ns, verdict, reason = self._now_ns(), Verdict.PASSED, ""
        standing = self._standing.results(now_ns, self._whole.requests)
        for rule in (*standing, *self._refused.results(now_ns), *self._whole.results(now_ns)):
            self.results.append(rule)
            if rule.vacuous and self._by_chance is not None:  # the campaign checks whether any of its seeds judged it
                continue
            if rule.verdict is not Verdict.PASSED and verdict is not Verdict.FAILED:
                verdict, reason = rule.verdict, f"{rule.number}: {rule.text}: {rule.got}"
        if self.scenario.invariants and not self._invariants:
            got = "not checked: a third-party controller publishes none of the checked values"
            self.results.append(
                CheckResult("invariants", "those of the system file", Verdict.SKIPPED, now_ns, 0, got=got)
            )
        if verdict is Verdict.PASSED and not self._judges():
            return Verdict.INCONCLUSIVE, "it has no expectation: no expect, wait, always or never"
        return verdict, reason

    def _judges(self) -> bool:
        """Return whether the scenario contains a check that can fail."""
        form = self.scenario.form
        if self._invariants:
            return True
        whole = (form.always, form.never, form.within, form.rate, form.cycle, form.judge, form.stopped, form.refused)
        return any(whole) or any(step.expect is not None or step.wait is not None for step in form.steps)

    def _on_event(self, event: TraceEvent) -> None:
        self._knowledge.hear(event)
        self._whole.hear(event)
        self._refused.hear(event)
        if event.kind is TraceKind.FRAME:
            for exchange in self._decoder.feed(event):
                self._whole.requests[exchange.device] += not exchange.is_stray
                self._dropped += len(self.exchanges) == KEPT
                self.exchanges.append(exchange)
                self._standing.saw(exchange)

    def _now_ns(self) -> int:
        return round(self.bench.now_s() * NS_PER_S)
