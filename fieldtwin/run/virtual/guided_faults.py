"""Random faults that the coverage of the run steers: their kinds by their effects, their begins by the states of the programs.

Faults of random kinds at random times mostly have no effect, or meet the states in which a plant spends most of its time. Here
each seed uses only some of the kinds of faults. A kind whose fault did not make a tag of its device bad is replaced by a
different kind.

A situation is a variable of a program with one of its values. Each seed aims at a random part of the situations. A fault begins
soon after the programs enter such a situation, with a probability of 1/(1+n) if n faults of this run have already begun in it.
The mean number of faults is that of a drawn schedule: the run saves up faults with time, and spends them when such a situation
begins. If it has saved `MOST_SAVED`, one begins at a random time.

The choice depends on the seed and on the events of the run only, so the same seed gives the same faults on every computer.
"""

from __future__ import annotations

import asyncio
from collections import Counter, deque
from random import Random
from typing import Any

from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.results.trace import Trace, TraceEvent, TraceKind, state_of
from fieldtwin.run.virtual.fault_schedule import MOST, FaultChoice, RandomFaults, drawn_fault, fault_choices, last_s
from fieldtwin.scenarios.bench import Bench
from fieldtwin.twin.prototype.group import SystemGroup

KINDS = (1, 2, 4)
"""The numbers of kinds of faults that a seed uses at a time, each equally frequent."""
AIMED = 0.25
"""The part of the situations at which a seed aims."""
MOST_SAVED = 4.0
"""Largest number of faults that a run saves up."""
DELAYS_S = (0.0, 2.0, 10.0)
"""A fault begins at a random time within one of these times in seconds after the situation has begun."""
EFFECT_S = 5.0
"""A tag that becomes bad within this time in seconds after the end of a fault counts as an effect of the fault."""
SHORTEST_WAIT_S = 0.01
"""Shortest time in seconds between two begins at random times; it keeps rounding errors from stopping the time."""
MOST_WAITING = 64
"""Largest number of begins that wait to be injected; more in the same moment are dropped."""

Situation = tuple[str, object]


class GuidedFaults:
    """The guided faults of one run: call `listen` with its trace before it begins, and `run` in its loop. `chosen` has the faults
    so far in the form of a fault file; injected at the start of a run with the same seed they have the same effect.
    """

    def __init__(self, group: SystemGroup, seed: int, duration_s: float, wanted: RandomFaults) -> None:
        self.chosen: list[dict[str, Any]] = []
        self._seed, self._last_s, self._random = seed, last_s(duration_s), Random(f"guided faults {seed}")
        self._choices = [choice for member in group.members.values() for choice in fault_choices(member, wanted)]
        self._all = sorted({kind for choice in self._choices for kind in choice.kinds})
        self._kinds = self._random.sample(self._all, min(self._random.choice(KINDS), len(self._all)))
        self._mean_s = wanted.mean_s / len(group.members)
        self._saved, self._at_s = MOST_SAVED / 2, 0.0
        self._now: dict[str, object] = {}
        """The state of each variable."""
        self._begun: Counter[Situation] = Counter()
        """The number of faults that began in each situation."""
        self._begins_s: deque[float] = deque(maxlen=MOST_WAITING)
        self._pending: list[dict[str, Any]] = []
        """The faults that have had no effect yet."""
        self._wake = asyncio.Event()

    def listen(self, trace: Trace) -> None:
        """Follow the states of the programs and the qualities of the tags in this trace."""
        trace.listen(self._state, TraceKind.STATE)
        trace.listen(self._tag, TraceKind.TAG)

    async def run(self, bench: Bench, **more: Any) -> None:
        """Inject faults until no further one can end in time. `more`: further keys of each fault."""
        loop = asyncio.get_running_loop()
        while self._choices and (now_s := bench.now_s()) < self._last_s and len(self.chosen) < MOST:
            self._save(now_s)
            if self._saved >= MOST_SAVED:
                self._spend(now_s + self._random.expovariate(1 / self._mean_s))
            while self._begins_s:
                await self._inject(bench, now_s, max(self._begins_s.popleft(), now_s), more)
            self._wake.clear()
            full_s = (MOST_SAVED - self._saved) * self._mean_s
            timer = loop.call_later(max(SHORTEST_WAIT_S, min(full_s, self._last_s - now_s)), self._wake.set)
            await self._wake.wait()
            timer.cancel()

    def _state(self, event: TraceEvent) -> None:
        value, now_s = state_of(event), event.t_ns / NS_PER_S
        if value is None:
            return
        self._now[event.where] = value
        situation = (event.where, value)
        self._save(now_s)
        if self._saved < 1 or not self._aims_at(situation) or self._random.random() * (1 + self._begun[situation]) >= 1:
            return
        self._spend(now_s + self._random.uniform(0.0, self._random.choice(DELAYS_S)))

    def _tag(self, event: TraceEvent) -> None:
        if event.data["quality"] != "good" and self._pending:
            now_s = event.t_ns / NS_PER_S
            self._pending = [
                fault
                for fault in self._pending
                if now_s < fault["from"] or not event.where.startswith(f"{fault['device']}.")
            ]

    def _aims_at(self, situation: Situation) -> bool:
        return Random(f"{self._seed} {situation}").random() < AIMED

    def _save(self, now_s: float) -> None:
        self._saved = min(MOST_SAVED, self._saved + (now_s - self._at_s) / self._mean_s)
        self._at_s = now_s

    def _spend(self, begin_s: float) -> None:
        self._saved -= 1
        self._begins_s.append(begin_s)
        self._wake.set()

    async def _inject(self, bench: Bench, now_s: float, at_s: float, more: dict[str, Any]) -> None:
        self._judge(now_s)
        choice = self._random.choice(self._fitting())
        fault = drawn_fault(choice, f"g{len(self.chosen) + 1}", at_s, self._last_s, self._random)
        if fault["until"] <= fault["from"]:
            return
        self._begun.update(self._now.items())
        self.chosen.append(fault)
        self._pending.append(fault)
        await bench.inject({**fault, **more})

    def _judge(self, now_s: float) -> None:
        """Replace the kinds of the faults that have ended without an effect."""
        for fault in self._pending:
            unused = [kind for kind in self._all if kind not in self._kinds]
            if fault["until"] + EFFECT_S < now_s and fault["name"] in self._kinds and unused:
                self._kinds[self._kinds.index(fault["name"])] = self._random.choice(unused)
        self._pending = [fault for fault in self._pending if fault["until"] + EFFECT_S >= now_s]

    def _fitting(self) -> list[FaultChoice]:
        """Return the targets for which one of the used kinds fits, with these kinds."""
        parts = [choice.only(self._kinds) for choice in self._choices]
        return [part for part in parts if part.kinds]


def guide_of(group: SystemGroup, seed: int, duration_s: float, wanted: RandomFaults | None) -> GuidedFaults | None:
    """Return the guided faults of a run; None if its faults are not guided."""
    return GuidedFaults(group, seed, duration_s, wanted) if wanted is not None and wanted.guided else None
