"""One fork: a prototype in virtual time that starts from the known state, executes a plan, and is observed up to the
horizon.

The gateway, the PLC and the emulators are those of every prototype run, unmodified; the events are summarized instead
of traced. The fork is isolated like every run in virtual time.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from contextlib import AsyncExitStack, ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fieldtwin.emulators.virtual.chance import seeded
from fieldtwin.emulators.virtual.loop import VirtualLoop
from fieldtwin.emulators.virtual.seal import sealed
from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.concurrency.nursery import Nursery
from fieldtwin.gateway.core.conditions.expression import Expression
from fieldtwin.gateway.core.errors import FieldtwinError, UsageError
from fieldtwin.gateway.core.values import Quality, Reason
from fieldtwin.gateway.wallclock import WallClock
from fieldtwin.plc.cycle.publishing import TagChange
from fieldtwin.plc.cycle.task import StopReason
from fieldtwin.run.processes.states import state_words
from fieldtwin.run.processes.topside import TopsideController
from fieldtwin.run.what_if.begin import begin, not_restored, retain_for
from fieldtwin.run.what_if.outcome import PlanOutcome, Requirement, Series
from fieldtwin.run.what_if.plan import WhatIfPlan
from fieldtwin.run.what_if.state import KnownState
from fieldtwin.twin.prototype.field_process import FieldConfig, resolve
from fieldtwin.twin.prototype.virtual import VirtualPrototype

LOOK_S = 1.0
"""Interval in seconds at which requirements are evaluated, in addition to each change of a program's variables."""
BEGUN_S = 2.0
"""If a plan has no command in the first `BEGUN_S` seconds, every program must be in its known state by then."""
MAX_TRANSITIONS = 10_000
MAX_HORIZON_S = 30 * 86_400.0


@dataclass(frozen=True)
class Fork:
    """A fork of `system` (name or path), from `state`, for `horizon_s` seconds.

    Requirements count from `settle_s` on, because before that the gateway has not read everything yet.
    """

    system: str
    state: KnownState
    horizon_s: float
    profiles: tuple[Path, ...] = ()
    prototype_file: Path | None = None
    seed: int | None = None
    settle_s: float = 5.0
    series: tuple[str, ...] = ()
    """Tags and variables whose values over time are wanted."""


def answer(fork: Fork, plan: WhatIfPlan) -> PlanOutcome:
    """Run `plan` in a fork.

    A failure inside it is in the outcome's `error`. Raises `FileInvalid` or `UsageError` if the fork cannot be started
    at all.
    """
    _check_horizon(fork)
    run = _ForkRun(fork, plan)
    clock = WallClock()
    began_ns = clock.monotonic_ns()
    run.run()
    run.outcome.took_s = (clock.monotonic_ns() - began_ns) / NS_PER_S
    return run.outcome


def check(fork: Fork, plan: WhatIfPlan) -> None:
    """Check that a fork can be started and that the plan's requirements can be evaluated; nothing is run.

    Raises like `answer`.
    """
    _check_horizon(fork)
    _ForkRun(fork, plan)


def _check_horizon(fork: Fork) -> None:
    if not 0 < fork.horizon_s <= MAX_HORIZON_S:
        raise UsageError("the horizon", expected="over 0 s to 30 days", got=f"{fork.horizon_s:g} s")


class _ForkRun:
    def __init__(self, fork: Fork, plan: WhatIfPlan) -> None:
        config = FieldConfig(
            system=fork.system,
            run_dir="",
            prototype=str(fork.prototype_file) if fork.prototype_file else "",
            profiles=tuple(map(str, fork.profiles)),
        )
        twin = resolve(config)
        self.fork, self.plan = fork, plan
        self.system, self.prototype = twin.ecs.system, twin.prototype
        self.outcome = PlanOutcome(plan.name, fork.horizon_s)
        self._words = {
            f"{p}.state": words for p, words in state_words(twin.ecs.layout, self.system.plc.programs).items()
        }
        self._known = [f"{d}.{t}" for d, c in self.system.devices.items() for t in c.profile.tags]
        self._variables = [t.name for region in twin.ecs.layout.regions for t in region.tags]
        self._requirements = [self._requirement("require", text) for text in plan.require]
        self._at_the_end = [self._requirement("finally", text) for text in plan.finally_]
        for name in fork.series:
            if name not in self._known and name not in self._variables:
                raise UsageError(
                    f"the system has no tag or variable {name!r}", expected="DEVICE.TAG or PROGRAM.VARIABLE"
                )
            self.outcome.series[name] = Series(fork.horizon_s)
        self._run: VirtualPrototype | None = None
        self._over = False

    def _requirement(self, kind: str, text: str) -> tuple[Requirement, Expression]:
        expression = Expression(text, [*self._known, *self._variables])
        made = Requirement(kind, text)
        self.outcome.requirements.append(made)
        return made, expression

    def run(self) -> None:
        loop = VirtualLoop()
        with ExitStack() as stack:
            run_dir = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="ft-what-if-")))
            stack.callback(loop.close)
            retain_for(self.fork.state, run_dir)
            with seeded(self.fork.seed or 0), sealed():
                try:
                    loop.run_until_complete(self._main(loop, run_dir))
                except FieldtwinError as e:
                    self.outcome.error = str(e)
            for context in loop.unhandled[:1]:
                told = f"{context.get('message')} {context.get('exception') or ''}".strip()
                self.outcome.error = self.outcome.error or f"unhandled exception: {told}"

    async def _main(self, loop: VirtualLoop, run_dir: Path) -> None:
        run = self._run = VirtualPrototype(
            self.system,
            self.prototype,
            loop,
            run_dir,
            seed=self.fork.seed,
            on_change=self._changed,
            prepare=lambda made: self.outcome.not_taken.extend(begin(made, self.fork.state)),
        )
        async with AsyncExitStack() as stack:
            await stack.enter_async_context(run)
            self.outcome.started_ns = run.started_ns
            unsubscribe = run.gateway.tags.subscribe(self.outcome.saw_tag)
            if self.plan.commands or run.field.far:  # without a topside controller, the modems would stay full
                nursery = await stack.enter_async_context(Nursery())
                nursery.start(self._topside().run(list(self.plan.commands)), "topside")
            for fault in self.plan.faults:
                run.field.faults.inject(fault)
            await self._watch(run, loop)
            # no requirement holds any more, whatever values the variables have
            if run.plc.stop_reason is not StopReason.NONE:
                self.outcome.error = f"the PLC stopped ({run.plc.stop_reason.value}): {run.plc.error or 'on request'}"
            self.outcome.ends(loop.now_ns)
            # The end of the run (safe outputs) is not part of the plan.
            unsubscribe()
            self._over = True
            for requirement, expression in self._at_the_end:
                self._judge(requirement, expression)

    def _topside(self) -> TopsideController:
        assert self._run is not None
        device = next(iter(self._run.field.far), None)
        if device is None:
            raise UsageError("this system cannot be commanded", expected="a transmitter with a topside end")
        return TopsideController(self.system, device, self._run.field.far[device], self._run.clock, self._run.net)

    async def _watch(self, run: VirtualPrototype, loop: VirtualLoop) -> None:
        end_ns = run.started_ns + round(self.fork.horizon_s * NS_PER_S)
        settled_ns = run.started_ns + round(min(self.fork.settle_s, self.fork.horizon_s) * NS_PER_S)
        begun = False
        while loop.now_ns < end_ns:
            await run.clock.sleep_until_ns(min(loop.now_ns + round(LOOK_S * NS_PER_S), end_ns))
            failure = run.failure()
            if failure is not None:
                raise failure
            if not begun and (not run.plc.starts.waiting or loop.now_ns >= settled_ns):
                begun = True
                if all(c.at_s > max(BEGUN_S, self._now_s()) for c in self.plan.commands):
                    self.outcome.not_taken.extend(not_restored(run, self.fork.state))
            if loop.now_ns >= settled_ns:
                for requirement, expression in self._requirements:
                    self._judge(requirement, expression)

    # -- what is seen ---------------------------------------------------------------------------------------------------

    def _now_s(self) -> float:
        assert self._run is not None
        return (self._run.loop.now_ns - self._run.started_ns) / NS_PER_S

    def _changed(self, change: TagChange) -> None:
        if self._over:
            return
        value = self._named(change.tag, change.after)
        assert self._run is not None  # this observation was recorded before any variable changed
        self.outcome.saw_variable(change.tag, value, self._run.loop.now_ns)
        if change.tag in self._words:
            seen = self.outcome.states.setdefault(change.tag.removesuffix(".state"), [])
            if len(seen) < MAX_TRANSITIONS:
                seen.append((self._now_s(), str(value)))

    def _named(self, tag: str, value: Any) -> Any:
        return self._words[tag].get(value, value) if tag in self._words else value

    def _judge(self, requirement: Requirement, expression: Expression) -> None:
        # A requirement whose value is unknown is not met either.
        if requirement.broken_s is None and expression.truth(self._look) is not True:
            requirement.broken_s = self._now_s()
            requirement.seen = "; ".join(
                f"{name}: {self._look('value', name)!r}" for name in dict.fromkeys(expression.names)
            )

    def _look(self, function: str, name: str) -> Any:
        run = self._run
        assert run is not None
        if name == "plc.late":
            return 0.0
        if name == "command_pending":
            return False
        tags = run.gateway.tags
        if name not in tags:
            outputs = run.plc.outputs.last()
            known = {
                "value": self._named(name, outputs.get(name)),
                "quality": "good",
                "age": 0.0,
                "reason": "",
                "updates": 0,
            }
            return known[function]
        now_ns = run.clock.monotonic_ns()
        seen = tags.current(name, now_ns)
        match function:
            case "quality" if seen.value is None:
                return None  # the quality has not turned bad, because the tag never had a value
            case "quality":
                return Quality(seen.quality).name.lower()
            case "reason":
                return Reason(seen.reason).name.lower()
            case "age":
                return (now_ns - seen.t_ns) / NS_PER_S
            case "updates":
                return self.outcome.variables[name].updates if name in self.outcome.variables else 0
        return seen.value


Progress = Callable[[PlanOutcome], None]
"""A function that is called with each outcome as soon as it is available."""
