"""A simulation: named values that change in fixed steps of the emulator's clock, and inputs that were written to devices.

The values depend only on the time and on the times of writes; nothing in this module waits. Steps that are due are computed at
the next access, each with the inputs that were valid at its own time. The same run therefore gives the same values, also in
virtual time.
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
"""The largest number of steps that one access takes after a long time without an access. Older steps are skipped and counted."""

Step = Callable[[float, float, Mapping[str, float]], Mapping[str, float]]
"""``step(t_s, dt_s, values)``: a function that returns the new values for the previous ones."""


class Simulation:
    """A running simulation: values by name from `start_ns` on, with a step every `step_ns`. The first step is at `start_ns`
    itself, with dt 0.

    `start` are the values before the first step, NaN if only the step determines them. `inputs` are the names that `put` may set;
    they are 0 at first. Values are constant between two steps. `of_time`: the step depends on the time since the start.
    """

    def __init__(
        self,
        step: Step,
        start: Mapping[str, float],
        inputs: Sequence[str],
        start_ns: int,
        step_ns: int,
        of_time: bool = False,
    ) -> None:
        if step_ns <= 0:
            raise UsageError("the step of a simulation", expected="more than 0 ns", got=str(step_ns))
        self.names = tuple(start)
        self.start_ns = start_ns
        self.skipped = 0
        """Steps that were skipped after a long time without an access."""
        self._step = step
        self._own_state = of_time or any(math.isnan(value) for value in start.values())
        self._step_ns = step_ns
        self._values: dict[str, float] = dict(start) | dict.fromkeys(inputs, 0.0)
        self._inputs = frozenset(inputs)
        self._next_ns = start_ns
        self._t_s = 0.0

    def put(self, name: str, value: float, now_ns: int) -> None:
        """Set the input `name` to `value` from `now_ns` on. Steps that were due before are computed with the earlier value."""
        if name not in self._inputs:
            raise UsageError(f"no input {name!r}", expected=", ".join(sorted(self._inputs)))
        self._advance(now_ns - 1)
        self._values[name] = value

    def begin_with(self, values: Mapping[str, float]) -> bool:
        """Set the values with which the next step starts. Return False if the step keeps its own state or follows the time."""
        known = {name: value for name, value in values.items() if name in self.names}
        self._values.update(known)
        return bool(known) and not self._own_state

    def values(self, now_ns: int) -> Mapping[str, float]:
        """Return all present values. Do not keep the mapping: it changes with the next step."""
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
    """Return a step that evaluates `formulas`, and the values before the first step (`start`, 0 by default).

    The formulas are evaluated in order: each sees the new values of the earlier ones, and the old values of itself and
    of later ones. Raises `UsageError` with the name.
    """
    known = (*formulas, *inputs)
    for name in start:
        if name not in formulas:
            raise UsageError(f"no formula or step computes {name!r}", expected=", ".join(formulas))
    made: dict[str, Formula] = {}
    for name, text in formulas.items():
        if name in (TIME, STEP) or name in inputs:
            raise UsageError(f"{name!r} is not a valid name for a value", expected="one that is not taken")
        made[name] = Formula(text, known, Random(f"{seed}:{name}"))

    def step(t_s: float, dt_s: float, values: Mapping[str, float]) -> Mapping[str, float]:
        scope = {**values, TIME: t_s, STEP: dt_s}
        for name, formula in made.items():
            scope[name] = formula(scope)
        return {name: scope[name] for name in made}

    return step, {name: float(start.get(name, 0.0)) for name in formulas}


def by_model(model: PythonModel, inputs: Sequence[str]) -> tuple[Step, dict[str, float]]:
    """Return a step of a Python model, and NaN as the initial value of each of its names.

    The names are those of a step of length 0 at time 0, taken here with all inputs 0. The step raises `FileInvalid` if
    it returns different names, because a device that uses a missing name would have no value.
    """
    names = tuple(model.step(0.0, 0.0, dict.fromkeys(inputs, 0.0)))
    for name in names:
        if name in inputs:
            raise FileInvalid(
                f"step() returned the input {name!r}", path=model.where, expected="a name that no input has"
            )

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
