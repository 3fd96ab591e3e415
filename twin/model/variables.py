"""The declared variables of a digital model: what each is, and the last that was heard of it, with its quality and time.

Which ones there are is fixed when the model is made, from the system file. They change by events alone. Pure: no wire, no clock,
no store; when something was so is what the event says.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

from fieldtwin.gateway.core.values import Quality, Reason, Scalar

Limits = tuple[float, float]
"""The least and the most that a value may be."""


@dataclass(frozen=True, slots=True)
class Variable:
    """A variable as it is declared (`name`, `kind`, `unit`, `limits`) and as it was last heard of.

    `t_ms` is when it was so, as the plant says, UTC; 0 where nothing was ever heard of it. What a plant cannot read any more it
    reports as bad, with the last value that it had.
    """

    name: str
    kind: str
    unit: str = ""
    limits: Limits | None = None
    value: Scalar | None = None
    quality: Quality = Quality.BAD
    reason: Reason = Reason.NEVER_READ
    t_ms: int = 0

    @property
    def heard(self) -> bool:
        """Whether the plant ever said anything of it."""
        return self.t_ms > 0

    @property
    def good(self) -> bool:
        """Whether it can be trusted as far as any value can."""
        return self.quality is Quality.GOOD

    def declared(self) -> dict[str, Any]:
        """What it is, for ``model.json``."""
        limits = {"limits": list(self.limits)} if self.limits is not None else {}
        return {"kind": self.kind, **({"unit": self.unit} if self.unit else {}), **limits}

    def describe(self) -> dict[str, Any]:
        """What is known of it, for JSON: bytes as hex, what is infinite as a word, the time None where it was never heard of."""
        value = self.value.hex() if isinstance(self.value, bytes) else self.value
        if isinstance(value, float) and not math.isfinite(value):
            value = str(value)
        unit = {"unit": self.unit} if self.unit else {}
        known = {"quality": str(self.quality), "reason": str(self.reason), "t_ms": self.t_ms or None}
        return {"value": value, **unit, **known}


class Variables(Mapping[str, Variable]):
    """The variables of one model, by name, in the order of their declaration. Two models never share one.

    `undeclared` counts what was told of names that the model does not have: it is no part of the model.
    """

    __slots__ = ("_held", "undeclared")

    def __init__(self, declared: Iterable[Variable] = ()) -> None:
        self._held = {variable.name: variable for variable in declared}
        self.undeclared = 0

    def __getitem__(self, name: str) -> Variable:
        return self._held[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._held)

    def __len__(self) -> int:
        return len(self._held)

    def changed(self, name: str, value: Scalar | None, quality: Quality, reason: Reason, t_ms: int) -> bool:
        """Event: the plant says that `name` is `value` since `t_ms`. False for one that the model does not declare."""
        held = self._held.get(name)
        if held is None:
            self.undeclared += 1
            return False
        self._held[name] = replace(held, value=value, quality=quality, reason=reason, t_ms=t_ms)
        return True

    def silent(self, name: str) -> None:
        """Event: `name` was not heard of for too long. Its last value stays to be read, and is bad."""
        held = self._held.get(name)
        if held is not None:
            self._held[name] = replace(held, quality=Quality.BAD, reason=Reason.STALE)

    def describe(self) -> dict[str, dict[str, Any]]:
        """What is known of each, for JSON."""
        return {name: held.describe() for name, held in self._held.items()}
