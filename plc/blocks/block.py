"""The base class of all function blocks, which keep their state between calls, with the declarations that the ST compiler
reads.

A block is called once per scan, with the scan's frozen time, in one of two ways:

    delay(scan.now_ns, IN=level_high, PT=2 * SECOND).Q      from Python, all inputs named and typed
    delay.IN = ...; delay.execute(now_ns); ... delay.Q       as a compiled ST call does: omitted inputs keep their value

Names of inputs and outputs are the standard's (IEC 61131-3). Times are integers in ns. A block must not depend on a clock, a
tag or the program that contains it.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from typing import Any, ClassVar

from fieldtwin.gateway.core.clock import NS_PER_MS, NS_PER_S

MS = NS_PER_MS
"""One millisecond in ns: ``PT=500 * MS``."""
SECOND = NS_PER_S


class FunctionBlock(ABC):
    """The base class of all blocks. `inputs` and `outputs` list names and IEC types in the standard's order."""

    __slots__ = ()
    inputs: ClassVar[dict[str, str]]
    outputs: ClassVar[dict[str, str]]

    @abstractmethod
    def execute(self, now_ns: int) -> None:
        """Execute one call at `now_ns`: set the outputs from the inputs and the state."""

    def members(self) -> Iterator[tuple[str, str, Any]]:
        """Return name, IEC type and present value of each input, then of each output."""
        for name, kind in (self.inputs | self.outputs).items():
            yield name, kind, getattr(self, name)

    def state(self, now_ns: int) -> tuple[Any, ...]:
        """Return the state on which the next calls depend, as a hashable value.

        Times are relative to `now_ns`, because only differences matter."""
        return tuple([_state(name, getattr(self, name), now_ns) for name in _slots(type(self))])


def _slots(block: type[object]) -> tuple[str, ...]:
    return tuple(str(name) for kind in block.__mro__ for name in getattr(kind, "__slots__", ()))


def _state(name: str, value: Any, now_ns: int) -> Any:
    if value is not None and name.startswith("_") and name.endswith("_ns"):
        return now_ns - value
    if isinstance(value, list):
        return tuple([_state(name, each, now_ns) for each in value])
    if isinstance(value, float):
        return repr(value)  # so that 0.0, -0.0 and NaN stay distinct
    if hasattr(value, "__slots__"):
        return tuple([_state(slot, getattr(value, slot), now_ns) for slot in _slots(type(value))])
    return value
