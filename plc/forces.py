"""Forces: values that a person puts in place of what a tag has, until they are taken away.

A forced input is what every program sees, SIMULATED; a forced output or local is set before the logic and again after it,
and is published SIMULATED (SPEC ruling 15). Bounded, and listed in every status. Nothing here asks whether a force is a
good idea: whoever sets one did.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import isfinite

from fieldtwin.gateway.core.errors import EndpointBusy, UsageError
from fieldtwin.gateway.core.image import TagKind, TagSpec
from fieldtwin.gateway.core.values import Scalar

MAX_FORCES = 256


@dataclass(frozen=True, slots=True)
class Force:
    """A forced tag: its value, since when (monotonic ns), and who did it."""

    value: Scalar
    since_ns: int
    by: str = ""


class Forces:
    """The forces of one PLC."""

    def __init__(self) -> None:
        self.inputs: dict[str, Force] = {}
        self.outputs: dict[str, Force] = {}

    def force(self, spec: TagSpec, value: Scalar, is_input: bool, now_ns: int, by: str = "") -> None:
        """Raises `UsageError` for a value that the tag cannot hold, `EndpointBusy` when there are too many."""
        table = self.inputs if is_input else self.outputs
        if len(self.inputs) + len(self.outputs) >= MAX_FORCES and spec.name not in table:
            raise EndpointBusy("too many forces", expected=f"at most {MAX_FORCES}")
        table[spec.name] = Force(checked(spec, value), now_ns, by)

    def unforce(self, tag: str) -> bool:
        """Take a force away; False if there was none."""
        found = self.inputs.pop(tag, None) or self.outputs.pop(tag, None)
        return found is not None

    def clear(self) -> int:
        """Take all away; how many there were."""
        count = len(self)
        self.inputs.clear()
        self.outputs.clear()
        return count

    def __len__(self) -> int:
        return len(self.inputs) + len(self.outputs)

    def describe(self, now_ns: int) -> dict[str, dict[str, Scalar]]:
        """JSON-able: tag to value, age in ms, and who forced it."""
        return {
            tag: {"value": f.value, "age_ms": (now_ns - f.since_ns) / 1e6, "by": f.by}
            for tag, f in sorted((self.inputs | self.outputs).items())
        }


def checked(spec: TagSpec, value: Scalar) -> Scalar:
    """`value` as one of the tag's kind. Raises `UsageError`."""
    if isinstance(value, int | float) and (isinstance(value, int) or isfinite(value)) and -(2**63) <= value < 2**63:
        if spec.kind is TagKind.REAL:
            return float(value)
        if spec.kind is TagKind.INT and value == int(value):
            return int(value)
        if spec.kind is TagKind.BOOL and value in (0, 1):
            return bool(value)
    raise UsageError(
        f"{spec.name} cannot be forced to that", expected=f"a value of kind {spec.kind.value}", got=repr(value)
    )
