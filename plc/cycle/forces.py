"""Forces: values that a user sets in place of a tag's value, until they are removed.

Every program sees the forced value of an input, with quality SIMULATED. A forced output or local is set before the logic runs,
and again afterwards, and is published as SIMULATED (paper.md, ruling 15). The number of forces is limited, and they are listed
in every status. This module does not check whether a force is safe: that is the user's decision.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import isfinite

from fieldtwin.gateway.core.errors import EndpointBusy, UsageError
from fieldtwin.gateway.core.image.image import TagKind, TagSpec
from fieldtwin.gateway.core.values import Scalar

MAX_FORCES = 256


@dataclass(frozen=True, slots=True)
class Force:
    """A forced tag: its value, the time when it was forced (monotonic ns), and the user who forced it."""

    value: Scalar
    since_ns: int
    by: str = ""


class Forces:
    """The forces of one PLC."""

    def __init__(self) -> None:
        self.inputs: dict[str, Force] = {}
        self.outputs: dict[str, Force] = {}

    def force(self, spec: TagSpec, value: Scalar, is_input: bool, now_ns: int, by: str = "") -> None:
        """Force a tag. Raises `UsageError` for a value that the tag cannot hold, `EndpointBusy` if there are too many
        forces."""
        table = self.inputs if is_input else self.outputs
        if len(self.inputs) + len(self.outputs) >= MAX_FORCES and spec.name not in table:
            raise EndpointBusy("too many forces", expected=f"at most {MAX_FORCES}")
        table[spec.name] = Force(checked(spec, value), now_ns, by)

    def unforce(self, tag: str) -> bool:
        """Remove a force; return False if there was none."""
        found = self.inputs.pop(tag, None) or self.outputs.pop(tag, None)
        return found is not None

    def clear(self) -> int:
        """Remove all forces; return how many were removed."""
        count = len(self)
        self.inputs.clear()
        self.outputs.clear()
        return count

    def __len__(self) -> int:
        return len(self.inputs) + len(self.outputs)

    def describe(self, now_ns: int) -> dict[str, dict[str, Scalar]]:
        """Return tag to value, age in ms, and the user who forced it, as data for JSON."""
        return {
            tag: {"value": f.value, "age_ms": (now_ns - f.since_ns) / 1e6, "by": f.by}
            for tag, f in sorted((self.inputs | self.outputs).items())
        }


def checked(spec: TagSpec, value: Scalar) -> Scalar:
    """Return `value` converted to the tag's kind. Raises `UsageError` for a value that the tag cannot hold."""
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
