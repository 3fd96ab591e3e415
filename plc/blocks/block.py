"""What all function blocks share: instances that keep their state between calls, and the declaration that ST reads.

A block is called once a scan, with the scan's frozen time, in either of two ways:

    delay(scan.now_ns, IN=level_high, PT=2 * SECOND).Q      from Python, all inputs named and typed
    delay.IN = ...; delay.execute(now_ns); ... delay.Q       what a compiled ST call does: inputs left out keep their value

Names of inputs and outputs are the standard's (IEC 61131-3). Times are integers in ns. A block must never know a clock, a
tag or the program that it is in.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar

MS = 1_000_000
"""One millisecond in ns: ``PT=500 * MS``."""
SECOND = 1_000_000_000


class FunctionBlock(ABC):
    """Base of all blocks. `inputs` and `outputs` name them with their IEC type, in the standard's order."""

    __slots__ = ()
    inputs: ClassVar[dict[str, str]]
    outputs: ClassVar[dict[str, str]]

    @abstractmethod
    def execute(self, now_ns: int) -> None:
        """One call at `now_ns`: outputs from inputs and from what was before."""
