"""A simulation: named values that change by fixed steps of the emulator's clock, and inputs that devices were written.

A function of time and of what was written when: nothing here waits, steps that fell due are taken when somebody looks, each
with the inputs that held at its own time. So the same run gives the same values, in virtual time as well.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from random import Random

from fieldtwin.emulators.simulation.formula import STEP, TIME, Formula
from fieldtwin.emulators.simulation.python_model import PythonModel
from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.errors import FileInvalid, UsageError

MAX_STEPS = 100_000
"""Steps taken at once after nobody looked for long. What is older is left out, and counted."""

Step = Callable[[float, float, Mapping[str, float]], Mapping[str, float]]
"""``step(t_s, dt_s, values)``: the new values, of those that were."""


class Simulation:
    """Values by name from `start_ns` on, a step every `step_ns`; the first is at `start_ns` itself, with dt 0.

    `start`: what the values are before the first step, NaN where only the step knows. `inputs` are the names that `put` may
    set; they are 0 before. Between two steps values stand still.
    """

    def __init__(
        self, step: Step, start: Mapping[str, float], inputs: Sequence[str], start_ns: int, step_ns: int
    ) -> None:
        if step_ns <= 0:
            raise UsageError("the step of a simulation", expected="more than 0 ns", got=str(step_ns))
        self.names = tuple(start)
        self.start_ns = start_ns
        self.skipped = 0
        """Steps that were left out because nobody had looked for so long."""
        self._step = step
        self._own_state = any(math.isnan(value) for value in start.values())
        self._step_ns = step_ns
        self._values: dict[str, float] = dict(start) | dict.fromkeys(inputs, 0.0)
        self._inputs = frozenset(inputs)
        self._next_ns = start_ns
        self._t_s = 0.0

    def put(self, name: str, value: float, now_ns: int) -> None:
        """An input is `value` from now on: what came before is computed with what it was before."""
        if name not in self._inputs:
            raise UsageError(f"no input {name!r}", expected=", ".join(sorted(self._inputs)))
        self._advance(now_ns - 1)
        self._values[name] = value

    def begin_with(self, values: Mapping[str, float]) -> bool:
        """Other values for the next step to begin with; False where the step has its state to itself."""
        known = {name: value for name, value in values.items() if name in self.names}
        self._values.update(known)
        return bool(known) and not self._own_state

    def values(self, now_ns: int) -> Mapping[str, float]:
        """All values now. To be read, not kept: it changes with the next step."""
        self._advance(now_ns)
        return self._values

    def _advance(self, now_ns: int) -> None:
        if now_ns < self._next_ns:
            return
        due = (now_ns - self._next_ns) // self._step_ns + 1
        if due > MAX_STEPS:
            self.skipped += due - MAX_STEPS
            self._next_ns += (due - MAX_STEPS) * self._step_ns
        while self._next_ns <= now_ns:
            t_s = (self._next_ns - self.start_ns) / NS_PER_S
            self._values.update(self._step(t_s, t_s - self._t_s, self._values))
            self._t_s = t_s
            self._next_ns += self._step_ns


def by_formulas(
    formulas: Mapping[str, str], start: Mapping[str, float], inputs: Sequence[str], seed: str
) -> tuple[Step, dict[str, float]]:
    """A step that evaluates `formulas` in their order: each sees the new values of those before it, and its own and later
    ones as they were; and what they are before the first step: `start`, 0 where not said. Raises `UsageError`, with the name.
    """
    known = (*formulas, *inputs)
    for name in start:
        if name not in formulas:
            raise UsageError(f"nothing computes {name!r}", expected=", ".join(formulas))
    made: dict[str, Formula] = {}
    for name, text in formulas.items():
        if name in (TIME, STEP) or name in inputs:
            raise UsageError(f"{name!r} is no name for a value", expected="one that is not taken")
        made[name] = Formula(text, known, Random(f"{seed}:{name}"))

    def step(t_s: float, dt_s: float, values: Mapping[str, float]) -> Mapping[str, float]:
        scope = {**values, TIME: t_s, STEP: dt_s}
        for name, formula in made.items():
            scope[name] = formula(scope)
        return {name: scope[name] for name in made}

    return step, {name: float(start.get(name, 0.0)) for name in formulas}


def by_model(model: PythonModel, inputs: Sequence[str]) -> tuple[Step, dict[str, float]]:
    """A step of a Python model, and what it computes, as no value: the names of a step at time 0 of length 0, taken here, with
    all inputs 0. The step raises `FileInvalid` when other names come: a device that plays one would have no value.
    """
    names = tuple(model.step(0.0, 0.0, dict.fromkeys(inputs, 0.0)))
    for name in names:
        if name in inputs:
            raise FileInvalid(f"step() returned the input {name!r}", path=model.where, expected="a name of its own")

    def step(t_s: float, dt_s: float, values: Mapping[str, float]) -> Mapping[str, float]:
        out = model.step(t_s, dt_s, {name: values[name] for name in inputs})
        if out.keys() != set(names):
            raise FileInvalid(
                f"step() returned other names at {t_s:g} s",
                path=model.where,
                expected=", ".join(names),
                got=", ".join(out),
            )
        return out

    return step, dict.fromkeys(names, math.nan)
