"""Run the cases against a client, one after the other, and check each.

The run first measures the client's usual behaviour. The device replies correctly before and after each case. A case
that cannot be carried out is skipped with the reason; a case without the client's participation is inconclusive.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass, field
from typing import Generic, Protocol, TypeVar

from fieldtwin.conformance.clients.probe import Probe
from fieldtwin.conformance.clients.recorder import Recorder
from fieldtwin.conformance.core.case import (
    OTHER_WIRE,
    TRAIL_S,
    CasePlan,
    ClientCase,
    Finding,
    Impact,
    inconclusive,
    skipped,
)
from fieldtwin.conformance.core.evidence import Line, lines
from fieldtwin.conformance.core.observation import (
    Ended,
    Event,
    Habit,
    Observation,
    ReplySent,
    RequestSeen,
    ValuePublished,
    Word,
)
from fieldtwin.conformance.core.results import CaseResult
from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.errors import Unreachable

POLL_S = 0.01
STEADY = 3
"""Number of polls in which the client's usual behaviour is measured."""
MANY = 1_000_000
"""Maximum number of wrong replies of a case that continues until the client has published the value of these replies."""


class Playable(Protocol):
    """A case with its reply function, for any protocol: see `ModbusCase` and `CanopenCase`."""

    @property
    def about(self) -> ClientCase: ...
    @property
    def wants(self) -> str: ...
    @property
    def strikes(self) -> int: ...
    @property
    def holds_good(self) -> bool: ...
    @property
    def framings(self) -> tuple[str, ...]: ...
    @property
    def needs(self) -> str: ...
    @property
    def trail_s(self) -> float: ...
    @property
    def least(self) -> int: ...


C = TypeVar("C", bound=Playable)
C_contra = TypeVar("C_contra", bound=Playable, contravariant=True)


class HostileDevice(Protocol[C_contra]):
    """The simulated device with which the cases run: see `HostileServer` and `HostileNode`. All times are those of its
    `now_ns`.
    """

    recorder: Recorder
    timeout_s: float
    struck: int
    first_ns: int
    last_ns: int
    pending: int

    def now_ns(self) -> int: ...
    def begin(self, case: C_contra, strikes: int) -> None: ...
    def end(self) -> None: ...
    def hold(self, word: Word) -> int:
        """Let the device hold the correct value that `word` names, from now on; return this value."""
        ...


@dataclass(frozen=True, slots=True)
class ClientPlan(CasePlan):
    """The plan of a run against a client. Times are in seconds.

    `timeout_s` is the client's response timeout, 0 if unknown; `patience_s` is the longest time of any step, `wait_s` the
    longest time to wait for the client's first request.
    """

    at_most: Impact = Impact.DISRUPT
    timeout_s: float = 0.0
    patience_s: float = 10.0
    wait_s: float = 30.0


@dataclass
class ClientRun(Generic[C]):
    """One conformance test of a client.

    `traits` are the features of the endpoint: a case runs if its `framings` contain one of them. `silent` is a case that
    leaves a request unanswered, which measures the client's timeout. `on_result` is called with each result.
    """

    stage: HostileDevice[C]
    cases: Sequence[C]
    silent: C
    plan: ClientPlan
    traits: frozenset[str]
    probe: Probe | None = None
    on_result: Callable[[CaseResult], None] = lambda result: None
    restart: Callable[[], Awaitable[None]] | None = None
    """Restarts the program under test, so that lasting damage by one case does not affect the next."""
    results: list[CaseResult] = field(default_factory=list)
    habit: Habit = field(default_factory=Habit)

    def __post_init__(self) -> None:
        self._word, self._held = Word.FIRST, 0
        self._ended: Ended | None = None
        self._started_ns = self.stage.now_ns()
        if self.probe is not None:
            self.probe.on_shown = self._shown

    # -- events from outside --------------------------------------------------------------------------------------

    def _shown(self, word: Word, text: str) -> None:
        self.stage.recorder.add(ValuePublished(self.stage.now_ns(), word, text))

    def ended(self, status: int) -> None:
        """Record that the program under test ended by itself."""
        self._ended = Ended(self.stage.now_ns(), status)
        self.stage.recorder.add(self._ended)

    @property
    def exit_code(self) -> int | None:
        """Return the program's exit code, if it ended by itself."""
        return self._ended.status if self._ended is not None else None

    # -- the run --------------------------------------------------------------------------------------------------

    async def run(self) -> list[CaseResult]:
        """Return the results in the order of the cases. Raises `Unreachable` if no client ever sent a request."""
        await self._learn()
        chosen = [case for case in self.cases if case.about.chosen(self.plan.only)]
        for case in [c for c in chosen if c.wants != "nothing"]:
            await self._case(case)
        for case in [c for c in chosen if c.wants == "nothing"]:
            self._watched(case)
        return self.results

    async def _learn(self) -> None:
        """Measure the client's polling behaviour, the representation of the correct words, and its response timeout."""
        stage = self.stage
        if not await self._until(
            lambda: any(isinstance(e, RequestSeen) for e in stage.recorder.since(0)), self.plan.wait_s
        ):
            if self._ended is not None:
                raise Unreachable(f"the program ended before its first request, exit code {self._ended.status}")
            raise Unreachable("no request was received", hint=f"within {self.plan.wait_s:g} s")
        since_ns = stage.now_ns()
        await self._until(lambda: stage.recorder.count(RequestSeen, since_ns) >= 2 * STEADY, self.plan.patience_s)
        if self.probe is not None:
            await self._teach(Word.FIRST)
            await self._teach(Word.SECOND)
        habit_since_ns, until_ns = since_ns, stage.now_ns()
        silent_gap_s = 0.0
        if self._ended is None:
            silent_gap_s = await self._silence()
        self.habit = stage.recorder.habit(habit_since_ns, until_ns, silent_gap_s)
        stage.timeout_s = self.plan.timeout_s or silent_gap_s or 1.0

    async def _teach(self, word: Word) -> None:
        assert self.probe is not None
        self._say(word)
        since_ns = self.stage.now_ns()
        await self._polled(STEADY, since_ns, self.plan.patience_s)
        await asyncio.sleep(TRAIL_S)
        probe = self.probe
        if not await self._until(lambda: probe.learn(word), self.plan.patience_s):
            raise Unreachable(
                "the probe never showed the device's value, or shows the same for all values",
                expected=f"the register {self._held}, as a whole number or converted without rounding",
                got=repr(probe.latest_text()) if probe.latest_text() else "nothing",
                hint="a program with the probe `output` has to flush each line",
            )

    async def _silence(self) -> float:
        """Return the time in seconds from an unanswered request to the next request; 0 if there was none."""
        self.stage.begin(self.silent, 1)
        await self._until(lambda: self.stage.struck > 0, self.plan.patience_s)
        first_ns = self.stage.first_ns
        if first_ns:
            await self._until(lambda: self._next_asked(first_ns) is not None, self.plan.patience_s)
        self.stage.end()
        following = self._next_asked(first_ns) if first_ns else None
        await self._polled(2, self.stage.now_ns(), self.plan.patience_s)
        return (following - first_ns) / NS_PER_S if following else 0.0

    def _next_asked(self, after_ns: int) -> int | None:
        return next((e.t_ns for e in self.stage.recorder.since(after_ns + 1) if isinstance(e, RequestSeen)), None)

    # -- one case -------------------------------------------------------------------------------------------------

    async def _case(self, case: C) -> None:
        since_ns = self.stage.now_ns()
        reason = self._why_not_possible(case)
        if reason:
            self._done(case, skipped(reason), since_ns)
        elif self.plan.for_s and (since_ns - self._started_ns) / NS_PER_S >= self.plan.for_s:
            self._done(case, inconclusive(f"not within {self.plan.for_s:g} s (--for)"), since_ns)
        elif not await self._well() and not await self._well_anew():
            why = "the client or master did not accept correct answers"
            if self._ended is not None:
                why = f"the client or master had ended, exit code {self._ended.status}"
            self._done(case, inconclusive(f"the state before the test case was not normal: {why}"), since_ns)
        else:
            finding, events = await self._play(case)
            self._done(case, finding, since_ns, lines(events, self.stage.first_ns))

    def _why_not_possible(self, case: C) -> str:
        if not self.traits & set(case.framings):
            return OTHER_WIRE
        if case.needs and case.needs not in self.plan.has:
            return f"only with --{case.needs}"
        if case.about.impact.rank > self.plan.at_most.rank:
            return f"its impact level is {case.about.impact.value}, {self.plan.at_most.value} is allowed"
        return ""

    async def _well(self) -> bool:
        """Wait until the client has received correct answers and published their value; return whether both happened in time."""
        since_ns = self.stage.now_ns()
        return await self._good_again(since_ns)

    async def _well_anew(self) -> bool:
        """Restart the program, and then do the same as `_well`."""
        if self.restart is None:
            return False
        self._ended = None
        await self._until(lambda: self.stage.pending == 0, self.plan.patience_s)  # a removed port has to be back
        await self.restart()
        await self._until(
            lambda: self.stage.recorder.count(RequestSeen, self.stage.now_ns() - NS_PER_S) > 0, self.plan.wait_s
        )
        return await self._well()

    async def _good_again(self, since_ns: int) -> bool:
        return await self._until(
            lambda: self.stage.recorder.count(ReplySent, since_ns) >= 2 and self._seen(self._word, since_ns),
            self.plan.patience_s,
        )

    def _seen(self, word: Word, since_ns: int) -> bool:
        if self.probe is None:
            return True
        return any(isinstance(e, ValuePublished) and e.word is word for e in self.stage.recorder.since(since_ns))

    async def _play(self, case: C) -> tuple[Finding, tuple[Event, ...]]:
        stage, before = self.stage, self._word
        after = Word.SECOND if before is Word.FIRST else Word.FIRST
        start_ns = stage.now_ns()
        if case.holds_good:
            self._say(after)
        stage.begin(case, MANY if case.holds_good and self.probe is not None else case.strikes)
        fits = await self._until(lambda: stage.struck > 0, min(self.plan.patience_s, 4 * self.habit.longest_gap_s + 1))
        if not fits:
            stage.end()
            return skipped(f"the client or master sent no {case.wants}"), ()
        done = (
            (lambda: self._seen(after, start_ns) and stage.struck >= case.least)
            if case.holds_good and self.probe
            else (lambda: stage.struck >= case.strikes)
        )
        await self._until(done, self.plan.patience_s)
        stage.end()
        last = before if case.holds_good else after
        # this is done immediately, because no correct answer may hold the value that only faulty answers held
        if case.holds_good:
            self._say(last)
        await self._until(lambda: stage.pending == 0, self.plan.patience_s)
        self._say(last)
        over_ns = stage.now_ns() if case.holds_good else max(stage.last_ns, stage.first_ns)
        await self._good_again(over_ns)
        while stage.last_ns > over_ns:  # a transfer that was in progress has continued
            over_ns = stage.last_ns
            await self._good_again(over_ns)
        await asyncio.sleep(case.trail_s)
        until_ns = stage.now_ns()
        events = stage.recorder.since(stage.first_ns)
        seen = Observation(
            events, stage.first_ns, over_ns, until_ns, self.habit, before, after, last,
            self.probe is not None, self.plan.timeout_s, self.plan.patience_s,
        )  # fmt: skip
        return case.about.check(seen), events

    def _watched(self, case: C) -> None:
        now_ns = self.stage.now_ns()
        reason = self._why_not_possible(case)
        if reason:
            self._done(case, skipped(reason), now_ns)
            return
        events = self.stage.recorder.since(0)
        self._done(case, case.about.check(Observation(events, 0, 0, now_ns, self.habit)), now_ns)

    def _done(self, case: C, finding: Finding, since_ns: int, wire: tuple[Line, ...] = ()) -> None:
        result = CaseResult(
            case.about.on_wire(self.traits), finding, (self.stage.now_ns() - since_ns) / NS_PER_S, wire=wire
        )
        self.results.append(result)
        self.on_result(result)

    # -- small things ---------------------------------------------------------------------------------------------

    def _say(self, word: Word) -> None:
        self._word = word
        self._held = self.stage.hold(word)

    async def _polled(self, count: int, since_ns: int, within_s: float) -> bool:
        return await self._until(lambda: self.stage.recorder.count(ReplySent, since_ns) >= count, within_s)

    async def _until(self, condition: Callable[[], bool], within_s: float) -> bool:
        """Wait at most `within_s` seconds for `condition`, or until the client has ended; return whether the condition holds."""
        loop = asyncio.get_running_loop()
        deadline = loop.time() + within_s
        while not condition():
            if loop.time() >= deadline or self._ended is not None:
                return condition()
            await asyncio.sleep(POLL_S)
        return True
