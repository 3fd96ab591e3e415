"""The declared variables of a digital model: their declarations, and the last reported value of each with quality and
time.

The system file determines the set of variables when the model is created. Only events change their values. This module uses no
connection, clock or store; the time of a value comes from its event.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

from fieldtwin.gateway.core.values import Quality, Reason, Scalar

Limits = tuple[float, float]
"""Smallest and largest permitted value."""


@dataclass(frozen=True, slots=True)
class ModelVariable:
    """A variable: its declaration (`name`, `kind`, `unit`, `limits`) and its last reported value.

    `t_ms` is the time (UTC) that the plant gives for the value; 0 if the plant has never reported the variable. When the
    plant can no longer read a variable, it reports the last value with bad quality.
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
        """Return whether the plant has reported this variable at least once."""
        return self.t_ms > 0

    @property
    def good(self) -> bool:
        """Return whether the quality is good."""
        return self.quality is Quality.GOOD

    def declared(self) -> dict[str, Any]:
        """Return the declaration, for ``model.json``."""
        limits = {"limits": list(self.limits)} if self.limits is not None else {}
        return {"kind": self.kind, **({"unit": self.unit} if self.unit else {}), **limits}

    def describe(self) -> dict[str, Any]:
        """Return value, unit, quality, reason and time as JSON data: bytes as hex, infinities and NaN as text, the time
        None if the variable was never reported.
        """
        value = self.value.hex() if isinstance(self.value, bytes) else self.value
        if isinstance(value, float) and not math.isfinite(value):
            value = str(value)
        unit = {"unit": self.unit} if self.unit else {}
        known = {"quality": str(self.quality), "reason": str(self.reason), "t_ms": self.t_ms or None}
        return {"value": value, **unit, **known}


class Variables(Mapping[str, ModelVariable]):
    """The variables of one model, by name, in the order of their declaration. Two models never share a variable.

    `undeclared` counts reports about names that the model does not declare. This counter is not part of the model's state.
    """

    __slots__ = ("_held", "undeclared")

    def __init__(self, declared: Iterable[ModelVariable] = ()) -> None:
        self._held = {variable.name: variable for variable in declared}
        self.undeclared = 0

    def __getitem__(self, name: str) -> ModelVariable:
        return self._held[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._held)

    def __len__(self) -> int:
        return len(self._held)

    def changed(self, name: str, value: Scalar | None, quality: Quality, reason: Reason, t_ms: int) -> bool:
        """Process the event that the plant reports `value` for `name` since `t_ms`.

        Return False if the model does not declare `name`.
        """
        held = self._held.get(name)
        if held is None:
            self.undeclared += 1
            return False
        self._held[name] = replace(held, value=value, quality=quality, reason=reason, t_ms=t_ms)
        return True

    def silent(self, name: str) -> None:
        """Process the event that `name` was not reported for too long. Its last value stays readable, with bad quality."""
        held = self._held.get(name)
        if held is not None:
            self._held[name] = replace(held, quality=Quality.BAD, reason=Reason.STALE)

    def describe(self) -> dict[str, dict[str, Any]]:
        """Return the last reported state of each variable, for JSON."""
        return {name: held.describe() for name, held in self._held.items()}
