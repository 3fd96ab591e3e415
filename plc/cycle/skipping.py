"""The decision whether a scan can be skipped, because it would change nothing.

A program qualifies if it describes its whole state (`Program.whole_state`); programs in Structured Text do. Its scan depends
only on this state, on its inputs, and on the time since the scan before. If a scan with unchanged inputs leaves the state as it
was, and nothing in the state refers to the present time (a running timer does), then every further scan with these inputs also
leaves the state and the outputs as they are. The logic is then not executed until an input changes. The scan itself still takes
place: it reads, publishes and counts as before.

This module must not depend on the image, on a cycle time or on what the programs do.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.plc.binding import BoundProgram
from fieldtwin.plc.program import Outbox, Program

LATER_NS = 3600 * NS_PER_S
"""A state that refers to the present time is a different one this much later."""
MOST_WAITED = 64
"""The largest number of scans between two comparisons of a state that keeps changing."""


def describes_its_state(program: Program) -> bool:
    """Return whether `whole_state` covers the `execute` of the program: it is declared in the same class, or in a derived one."""
    for kind in type(program).__mro__:
        if "whole_state" in vars(kind):
            return kind is not Program
        if "execute" in vars(kind):
            return False
    return False


class Settling:
    """Finds out whether the `programs` of a task are settled: another scan with the same inputs would change nothing."""

    def __init__(self, programs: Sequence[BoundProgram], state_of: Callable[[BoundProgram, int], Any]) -> None:
        """`state_of` returns the whole state of a program at a time (ns)."""
        self.possible = bool(programs) and all(describes_its_state(bound.program) for bound in programs)
        self.settled = False
        self._programs = tuple(programs)
        self._state_of = state_of
        self._outboxes = [v for b in programs for v in vars(b.program).values() if isinstance(v, Outbox)]
        self._before: list[Any] | None = None
        """The state after the previous scan, if the inputs have been the same since then and the state was compared."""
        self._wait, self._waited = 1, 0

    def disturbed(self) -> None:
        """Begin again after a change: of an input, by a force, by a message."""
        self.settled, self._before, self._waited = False, None, 0

    def executed(self, now_ns: int, *, same_outputs: bool) -> None:
        """Compare the state after a scan, whose inputs were those of the scan before, with the state before it.

        Call it before the messages that the scan sent are published. A state that keeps changing is compared less and less
        often, because a comparison can take longer than a scan.
        """
        self._waited += 1
        if self._waited < self._wait:
            return
        state = self._state(now_ns)
        before, self._before = self._before, state
        if before is None:
            return
        quiet = same_outputs and None not in state and not any(box.pending for box in self._outboxes)
        self.settled = quiet and state == before and state == self._state(now_ns + LATER_NS)
        self._before, self._waited = None, 0
        self._wait = 1 if self.settled else min(2 * self._wait, MOST_WAITED)

    def _state(self, now_ns: int) -> list[Any]:
        """Return the states of the programs, and how often a full outbox refused a message, which each scan may count."""
        return [self._state_of(bound, now_ns) for bound in self._programs] + [box.waits for box in self._outboxes]
