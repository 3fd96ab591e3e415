"""Traces of variables: their values after each scan, in a ring of limited size, with or without a trigger.

A trace without a trigger keeps the last scans. One with a trigger keeps some scans before the first scan in which its condition
is TRUE, then records the wanted number of scans after it, and is complete. This module must not know how requests arrive.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import Enum
from itertools import islice
from typing import Any

from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.gateway.core.values import Scalar

MAX_VARIABLES = 32
"""The largest number of variables of one trace."""
MAX_SCANS = 100_000
"""The largest number of scans in a ring."""
MAX_BYTES = 32 * 1024 * 1024
"""The largest size of a ring in bytes, as `row_bytes` estimates it."""
ROW_BYTES, VALUE_BYTES, TEXT_BYTES = 120, 32, 300
"""The memory of a row without values, of a number with its place in the row, and of a text."""
VALUES_AT_ONCE = 2_000
"""The largest number of values in one answer, which takes about 1 ms, because it delays a scan that is due."""

Traced = Scalar | str | None


class TraceState(Enum):
    RECORDING = "recording"
    WAITING = "waiting"
    TRIGGERED = "triggered"
    COMPLETE = "complete"


@dataclass(frozen=True, slots=True)
class TracedVariable:
    """A variable of a trace, with the function that reads its present value. `type` is its IEC type, or the kind of its tag."""

    name: str
    type: str
    read: Callable[[], Traced]
    unit: str = ""
    is_text: bool = False


@dataclass(frozen=True, slots=True)
class TraceRow:
    """The values after a scan at `t_ns` (monotonic). `number` counts the rows of the trace from 0."""

    number: int
    scan: int
    t_ns: int
    values: tuple[Traced, ...]


@dataclass(frozen=True, slots=True)
class TraceSize:
    """How many scans a trace keeps: before the trigger, and from it on. Without a trigger it keeps `before` scans."""

    before: int
    after: int = 0


def row_bytes(variables: Sequence[TracedVariable]) -> int:
    """Return the estimated memory of a row in bytes."""
    return ROW_BYTES + sum(TEXT_BYTES if one.is_text else VALUE_BYTES for one in variables)


class VariableTrace:
    """One trace. Raises `UsageError` for a trace that would be too large.

    `trigger` returns after each scan whether its condition is TRUE; without it the trace never is complete.
    """

    def __init__(
        self, variables: Sequence[TracedVariable], size: TraceSize, trigger: Callable[[], bool] | None = None
    ) -> None:
        scans, most = size.before + size.after, min(MAX_SCANS, MAX_BYTES // row_bytes(variables))
        if not 1 <= len(variables) <= MAX_VARIABLES:
            raise UsageError("the variables of a trace", expected=f"1 to {MAX_VARIABLES}", got=str(len(variables)))
        if size.before < 0 or size.after < 0 or not 1 <= scans <= most:
            raise UsageError("the scans of a trace", expected=f"1 to {most} with these variables", got=str(scans))
        if trigger is not None and size.after < 1:
            raise UsageError("the scans after the trigger", expected="at least 1", got=str(size.after))
        self.variables = tuple(variables)
        self.size = size
        self.state = TraceState.RECORDING if trigger is None else TraceState.WAITING
        self.triggered_row: int | None = None
        """The number of the row of the trigger."""
        self.error = ""
        """Why the condition of the trigger has no value; empty if it has one."""
        self._trigger = trigger
        self._rows: deque[TraceRow] = deque(maxlen=scans)
        self._number = 0

    @property
    def rows(self) -> Sequence[TraceRow]:
        """Return the rows that are kept, the oldest first."""
        return self._rows

    def record(self, t_ns: int, scan: int) -> None:
        """Record the values after a scan."""
        if self.state is TraceState.COMPLETE:
            return
        self._rows.append(TraceRow(self._number, scan, t_ns, tuple([one.read() for one in self.variables])))
        if self.state is TraceState.WAITING:
            self._look()
        if self.triggered_row is not None and self._number - self.triggered_row + 1 >= self.size.after:
            self.state = TraceState.COMPLETE
        self._number += 1

    def _look(self) -> None:
        assert self._trigger is not None
        try:
            fulfilled = self._trigger()
            self.error = ""
        except UsageError as e:
            fulfilled, self.error = False, e.message
        if fulfilled:
            self.triggered_row, self.state = self._number, TraceState.TRIGGERED
        while not fulfilled and len(self._rows) > self.size.before:
            self._rows.popleft()  # room for the scans after the trigger

    def since(self, number: int) -> list[TraceRow]:
        """Return the kept rows from `number` on, at most as many as fit into one answer."""
        if not self._rows:
            return []
        skipped = max(0, number - self._rows[0].number)
        most = max(1, VALUES_AT_ONCE // (len(self.variables) + 2))
        return list(islice(self._rows, skipped, skipped + most))

    def describe(self) -> dict[str, Any]:
        """Return the state of the trace as data for JSON."""
        return {
            "state": self.state.value,
            "triggered_row": self.triggered_row,
            "first_row": self._rows[0].number if self._rows else self._number,
            "next_row": self._number,
            "error": self.error,
        }
