"""Runs a scenario on a bench: step after step, while what must always and never hold is looked at.

A step that fails ends the scenario; what comes behind it was not reached. It knows no target: what one cannot do is SKIPPED, what
its host's lateness makes worthless INCONCLUSIVE, and neither ever passes.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Iterable
from dataclasses import dataclass
from typing import Any

from emulators.faults.schema import seconds
from fieldtwin.conformance.case import Danger
from fieldtwin.decoding.decoder import Decoder
from fieldtwin.decoding.exchange import SECRET, Exchange
from fieldtwin.report.model import CheckResult, ScenarioResult, Verdict
from fieldtwin.scenarios.about import dangers, result_of
from fieldtwin.scenarios.bench import Bench, Can
from fieldtwin.scenarios.expectation import Watched, is_secret, judge_tag, judge_wire
from fieldtwin.scenarios.expression import Expression
from fieldtwin.scenarios.form import Scenario, needs_of
from fieldtwin.scenarios.trace import Event, Kind
from fieldtwin.scenarios.whole_run import WholeRun
from fieldtwin.scenarios.words import Expect, Step, WireForm, word_of
from gateway.core.errors import UsageError

TICK_S = 0.02
"""How often is looked while something is waited for."""
PENDING_S = 5.0
RECENT_S = 2.0
"""How long ago the host's lateness may have been and still show in what is looked at now."""
KEPT = 20_000
LATE_SHARE = 0.1
"""A host that was late by more than this part of the time that a check is about has proved nothing."""
_NS = 1_000_000_000


@dataclass
class _Broken(Exception):
    """A check that says no: the verdict, what was expected, what came. `bound_s`: the time that it is about, 0 for none;
    `since_s`: from when on the host's lateness counts, where that is not the step's begin."""

    verdict: Verdict
    expected: str
    got: str
    bound_s: float = 0.0
    since_s: float | None = None


def refusal(scenario: Scenario, target: str, can: Collection[Can], allowed: Danger) -> str:
    """Why a target cannot do what the scenario is made of, or may not have it done to it; empty when all is well."""
    lacking = [need.value for need in scenario.needs if need not in can]
    if lacking:
        steps = [
            str(n)
            for n, step in enumerate(scenario.form.steps, 1)
            if any(need.value in lacking for need in needs_of(step))
        ]
        said = f" (step{'s' if len(steps) > 1 else ''} {', '.join(steps[:5])})" if steps else ""
        return f"the target {target} cannot {', '.join(lacking)}{said}"
    for danger, what in dangers(scenario):
        if danger.rank > allowed.rank:
            said = f"{what} is of the class {danger.value}, and the target {target} allows {allowed.value}"
            return f"{said} (--allow {danger.value})"
    return ""


class Runner:
    """One scenario on one bench. ``await run()`` once."""

    def __init__(self, scenario: Scenario, bench: Bench) -> None:
        self.scenario = scenario
        self.bench = bench
        self.results: list[CheckResult] = []
        self.exchanges: deque[Exchange] = deque(maxlen=KEPT)
        self._decoder = Decoder(scenario.system)
        self._always = [
            (f"always {n}", text, e, True) for n, (text, e) in _numbered(scenario.form.always, scenario.always)
        ]
        self._never = list(enumerate(scenario.never, 1))
        self._dropped = 0
        self._judged: set[str] = set()
        """What must always or never hold and of which everything was known at least once."""
        self._stimulus_s = 0.0
        self._sent_s = -PENDING_S
        self._watched: deque[Exchange] = deque()
        self._excused: list[bool] = []
        self._whole = WholeRun(scenario, bench, self._look)
        bench.trace.listen(self._on_event)

    async def run(self) -> ScenarioResult:
        """All steps. Never raises for what the system does; raises what a bench raises that is gone."""
        scenario, form = self.scenario, self.scenario.form
        refused = refusal(scenario, self.bench.target, self.bench.can, self.bench.allowed)
        verdict, reason = Verdict.PASSED, ""
        if refused:
            verdict, reason = Verdict.SKIPPED, refused
        else:
            for n, step in enumerate(form.steps):
                result = await self._step(n, step)
                self.results.append(result)
                if result.verdict is not Verdict.PASSED:
                    verdict, reason = result.verdict, f"step {result.number}: {result.text}"
                    break
            if verdict is Verdict.PASSED:
                verdict, reason = await self._hold_to_the_end()
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
        )

    # -- steps ----------------------------------------------------------------------------------------------------------

    async def _step(self, n: int, step: Step) -> CheckResult:
        word, since_s = word_of(step), self.bench.now_s()
        text = f"{word}: {_said(getattr(step, word))}"
        self.bench.trace.note(self._now_ns(), Kind.STEP, str(n + 1), {"text": text})
        expected = got = ""
        verdict = Verdict.PASSED
        try:
            self._look_at_all()
            await self._do(n, word, step)
            self._look_at_all()
        except _Broken as broken:
            verdict, expected, got = self._judged_on_time(broken, since_s)
        except UsageError as e:
            verdict, got = Verdict.ERROR, str(e)
        result = CheckResult(
            str(n + 1),
            text,
            verdict,
            self._now_ns(),
            round(since_s * _NS),
            expected,
            got,
            where=self.scenario.line("steps", n),
            names=self._about(n, step),
        )
        self.bench.trace.note(self._now_ns(), Kind.STEP, str(n + 1), {"text": text, "verdict": verdict.value})
        return result

    def _about(self, n: int, step: Step) -> tuple[str, ...]:
        """The tags, variables or device that a step looks at; whatever came of it."""
        if step.wait is not None:
            return tuple(self.scenario.expression(step.wait.until, "steps", n, "wait", "until").names)
        if step.expect is None:
            return ()
        if step.expect.that is not None:
            return tuple(self.scenario.expression(step.expect.that, "steps", n, "expect", "that").names)
        return (step.expect.wire or step.expect.tag or "",)

    def _judged_on_time(self, broken: _Broken, since_s: float) -> tuple[Verdict, str, str]:
        """What is broken; where the host itself was late by a good part of the time that it is about, nobody knows."""
        late_s = self.bench.host_late_s(since_s if broken.since_s is None else broken.since_s)
        if broken.verdict is Verdict.FAILED and broken.bound_s and late_s > LATE_SHARE * broken.bound_s:
            got = f"{broken.got}; but this host was {late_s * 1000:.0f} ms late by itself"
            return Verdict.INCONCLUSIVE, broken.expected, got
        return broken.verdict, broken.expected, broken.got

    async def _do(self, n: int, word: str, step: Step) -> None:
        bench = self.bench
        if word in ("send", "set", "fault", "clear"):
            self._stimulus_s = bench.now_s()
        if step.send is not None:
            self._sent_s = bench.now_s()
            await bench.send(step.send.period_s)
        elif step.set is not None:
            device, _, tag = step.set.tag.rpartition(".")
            await bench.set_value(device, tag, step.set.value)
        elif step.fault is not None:
            await bench.inject({"id": f"step {n + 1}", **step.fault})
        elif step.clear is not None:
            await bench.clear(step.clear)
        elif step.pause is not None:
            await self._until(bench.now_s() + seconds(step.pause))
        elif step.wait is not None:
            expression = self.scenario.expression(step.wait.until, "steps", n, "wait", "until")
            await self._wait(expression, seconds(step.wait.within))
        elif step.expect is not None:
            await self._expect(n, step.expect)

    async def _wait(self, expression: Expression, within_s: float) -> None:
        deadline_s = self.bench.now_s() + within_s
        while not expression.evaluate(self._look):
            if self.bench.now_s() >= deadline_s:
                got = self._seen_of(expression)
                raise _Broken(
                    Verdict.FAILED, f"{expression.text} within {within_s:g} s", got, self._bound(expression, within_s)
                )
            await self._tick(deadline_s)

    async def _expect(self, n: int, expect: Expect) -> None:
        within_s = seconds(expect.within) if expect.within is not None else 0.0
        during_s = seconds(expect.during) if expect.during is not None else 0.0
        if expect.that is not None:
            expression = self.scenario.expression(expect.that, "steps", n, "expect", "that")
            await self._wait(expression, within_s)
            await self._throughout(expression, during_s)
            return
        watched = Watched(self.bench, self.scenario.system, self.bench.now_s(), self._stimulus_s, self.exchanges)
        if expect.wire is not None:
            dropped = self._dropped
            await self._until(self.bench.now_s() + max(within_s, during_s))
            if self._dropped != dropped:
                raise _Broken(
                    Verdict.INCONCLUSIVE, f"at most {KEPT} exchanges in that time", "more; some were forgotten"
                )
            said = judge_wire(expect, watched)
            if said is not None:
                raise _Broken(Verdict.FAILED, *said, max(within_s, during_s))
            return
        assert expect.tag is not None
        if expect.updates_per_s is not None:
            await self._until(self.bench.now_s() + max(during_s, 1.0))
        deadline_s = self.bench.now_s() + within_s
        while (said := await judge_tag(expect, watched)) is not None:
            if self.bench.now_s() >= deadline_s or expect.updates_per_s is not None:
                raise _Broken(Verdict.FAILED, *said, max(within_s, during_s))
            await self._tick(deadline_s)
        if expect.updates_per_s is None:
            end_s = self.bench.now_s() + during_s
            while self.bench.now_s() < end_s:  # and it stays so
                await self._tick(end_s)
                if (said := await judge_tag(expect, watched)) is not None:
                    raise _Broken(Verdict.FAILED, *said, during_s)
            self._looked_all_the_time(end_s - during_s, during_s)

    async def _throughout(self, expression: Expression, during_s: float) -> None:
        end_s = self.bench.now_s() + during_s
        while self.bench.now_s() < end_s:
            await self._tick(end_s)
            if not expression.evaluate(self._look):
                got = self._seen_of(expression)
                raise _Broken(
                    Verdict.FAILED, f"{expression.text} for {during_s:g} s", got, self._bound(expression, during_s)
                )
        self._looked_all_the_time(end_s - during_s, during_s)

    def _looked_all_the_time(self, since_s: float, during_s: float) -> None:
        """What lasts must have been looked at: not while this host did something else."""
        late_s = self.bench.host_late_s(since_s)
        if during_s and late_s > LATE_SHARE * during_s:
            raise _Broken(
                Verdict.INCONCLUSIVE,
                f"looked at for {during_s:g} s",
                f"this host was {late_s * 1000:.0f} ms late by itself",
            )

    @staticmethod
    def _bound(expression: Expression, limit_s: float = 0.0) -> float:
        """The shortest time that a check is about."""
        return min([t for t in (limit_s, *expression.times_s) if t > 0], default=0.0)

    # -- time, and what holds all the time --------------------------------------------------------------------------------

    async def _until(self, t_s: float) -> None:
        while self.bench.now_s() < t_s:
            await self._tick(t_s)

    async def _tick(self, at_most_s: float) -> None:
        await self.bench.sleep_until_s(min(self.bench.now_s() + TICK_S, max(at_most_s, self.bench.now_s() + 0.001)))
        self._look_at_all()

    def _look_at_all(self) -> None:
        """What must always and never hold, now. Raises `_Broken`."""
        for number, text, expression, _ in self._always:
            if not self._is_known(number, expression):
                continue
            if not expression.evaluate(self._look):
                seen, bound_s = self._seen_of(expression), self._bound(expression)
                raise _Broken(
                    self._of_lateness(expression.asks_lateness), f"{number}: {text}", seen, bound_s, self._recently()
                )
        for n, one in self._never:
            if not isinstance(one, Expression) or not self._is_known(f"never {n}", one):
                continue
            if one.evaluate(self._look):
                seen, bound_s = self._seen_of(one), self._bound(one)
                raise _Broken(
                    self._of_lateness(one.asks_lateness), f"never {n}: {one.text}", seen, bound_s, self._recently()
                )
        if (said := self._whole.look()) is not None:
            verdict = self._of_lateness("plc.late" in said.names)
            since_s = self.bench.now_s() - said.bound_s - RECENT_S
            got = "; ".join([said.got, *([self._seen(names)] if (names := self._readable(said.names)) else [])])
            raise _Broken(verdict, f"{said.number}: {said.expected}", got, said.bound_s, since_s)
        excused = [self._is_excused(one) for _, one in self._never]
        while self._watched:
            exchange = self._watched.popleft()
            for (n, one), now, before in zip(self._never, excused, self._excused or excused, strict=True):
                if isinstance(one, WireForm) and not (now or before) and self._forbidden(one, exchange):
                    raise _Broken(Verdict.FAILED, f"never {n}: {_said(one)}", exchange.text)
        self._excused = excused

    def _is_known(self, number: str, expression: Expression) -> bool:
        """Whether all that it names is known, or was before: from then on it is judged."""
        if number not in self._judged and any(self.bench.reading(name) is None for name in expression.names):
            return False
        self._judged.add(number)
        return True

    def _of_lateness(self, asked: bool) -> Verdict:
        """The verdict on a check that asks how late scans are: a plant answers for it, a host that plays one does not."""
        ours = asked and Can.EXACT_TIME not in self.bench.can and self.bench.target != "real"
        return Verdict.INCONCLUSIVE if ours else Verdict.FAILED

    def _recently(self) -> float:
        return self.bench.now_s() - RECENT_S

    def _is_excused(self, one: Expression | WireForm) -> bool:
        """Whether `unless` holds: what was seen since the last look may be older than this moment."""
        if not isinstance(one, WireForm) or one.unless is None:
            return False
        return bool(self.scenario.expression(one.unless, "never").evaluate(self._look))

    def _forbidden(self, form: WireForm, exchange: Exchange) -> bool:
        if exchange.device != form.wire or (form.function is not None and exchange.function != form.function):
            return False
        if form.access is not None and form.access not in exchange.access:
            return False
        if form.register_ is not None and form.register_ not in exchange.tags:
            return False
        return form.value is None or exchange.tags.get(form.register_ or "") == form.value

    async def _hold_to_the_end(self) -> tuple[Verdict, str]:
        """What held all the time is said so, once; what could never be judged makes the scenario inconclusive."""
        since_s = self.bench.now_s()
        try:
            while self._whole.pending_until_s:
                await self._tick(self._whole.pending_until_s)
        except _Broken as broken:
            verdict, expected, got = self._judged_on_time(broken, since_s)
            number = expected.partition(":")[0]
            now_ns = self._now_ns()
            self.results.append(CheckResult(number, expected, verdict, now_ns, round(since_s * _NS), expected, got))
            return verdict, f"{expected}: {got}"
        now_ns, verdict, reason = self._now_ns(), Verdict.PASSED, ""
        for number, text, expression, _ in self._always:
            found = Verdict.PASSED if number in self._judged else Verdict.INCONCLUSIVE
            if found is not Verdict.PASSED:
                verdict, reason = found, f"{number}: nothing was ever known of {', '.join(expression.names)}"
            self.results.append(CheckResult(number, text, found, now_ns, 0, names=tuple(expression.names)))
        for n, one in self._never:
            number = f"never {n}"
            if isinstance(one, Expression):
                text, known, about = one.text, number in self._judged, ", ".join(one.names)
            else:
                text, known, about = _said(one), self._whole.requests[one.wire] > 0, f"the wire of {one.wire}"
            found = Verdict.PASSED if known else Verdict.INCONCLUSIVE
            if not known:
                verdict, reason = found, f"{number}: nothing was ever known of {about}"
            self.results.append(CheckResult(number, text, found, now_ns, 0))
        for number, text, seen, known in self._whole.summary():
            found = Verdict.PASSED if known else Verdict.INCONCLUSIVE
            if not known:
                verdict, reason = found, f"{number}: {text}: nothing was there to judge"
            self.results.append(CheckResult(number, text, found, now_ns, 0, got=seen))
        if verdict is Verdict.PASSED and not self._judges():
            return Verdict.INCONCLUSIVE, "it expects nothing: no expect, no wait, nothing that always or never holds"
        return verdict, reason

    def _judges(self) -> bool:
        """Whether anything in it could have failed."""
        form = self.scenario.form
        whole = (form.always, form.never, form.within, form.rate, form.cycle, form.judge)
        return any(whole) or any(step.expect is not None or step.wait is not None for step in form.steps)

    def _on_event(self, event: Event) -> None:
        self._whole.hear(event)
        if event.kind is Kind.FRAME:
            for exchange in self._decoder.feed(event):
                self._whole.requests[exchange.device] += 1
                self._dropped += len(self.exchanges) == KEPT
                self.exchanges.append(exchange)
                if any(isinstance(one, WireForm) for _, one in self._never):
                    self._watched.append(exchange)

    # -- what is known ----------------------------------------------------------------------------------------------------

    def _now_ns(self) -> int:
        return round(self.bench.now_s() * _NS)

    def _look(self, function: str, name: str) -> Any:
        if name == "plc.late":
            return self.bench.late_ms() / 1000
        if name == "command_pending":
            return self.bench.now_s() - self._sent_s <= PENDING_S
        reading = self.bench.reading(name)
        if reading is None:
            return {"quality": "bad", "reason": "never read", "updates": 0}.get(function)
        if function == "age":
            return reading.age_s
        return getattr(reading, function)

    def _seen_of(self, expression: Expression) -> str:
        late = [f"scans up to {self.bench.late_ms():.3g} ms late"] if expression.asks_lateness else []
        return "; ".join([*late, *([self._seen(expression.names)] if expression.names else [])])

    def _readable(self, names: Iterable[str]) -> list[str]:
        """Those that have a value: no device, nor ``plc.late``."""
        return [name for name in names if name in self.scenario.known]

    def _seen(self, names: Iterable[str]) -> str:
        told = []
        for name in dict.fromkeys(names):
            reading, shown = self.bench.reading(name), "never published"
            if reading is not None:
                value = SECRET if is_secret(self.scenario.system, name) else repr(reading.value)
                shown = f"{value} {reading.quality}, {reading.age_s:.3f} s old"
            told.append(f"{name}: {shown}")
        return "; ".join(told)


def _numbered(texts: list[str], expressions: tuple[Expression, ...]) -> Iterable[tuple[int, tuple[str, Expression]]]:
    return enumerate(zip(texts, expressions, strict=True), 1)


def _said(part: Any) -> str:
    """A step's own words."""
    if hasattr(part, "model_dump"):
        part = part.model_dump(exclude_none=True, exclude_defaults=True, by_alias=True)
    if isinstance(part, dict):
        return ", ".join(f"{key} {_said(value)}" for key, value in part.items())
    return str(part)
