"""A trace of variables of programs, scan by scan, as it was read from a PLC in virtual time or in a running instance."""

from __future__ import annotations

import csv
import io
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.plc.runtime.variable_trace import Traced, TraceRow


@dataclass(frozen=True, slots=True)
class TraceColumn:
    """A traced variable. The values of a time (`unit` ns) are shown in seconds."""

    name: str
    type: str
    unit: str = ""

    @property
    def shown_unit(self) -> str:
        return "s" if self.unit == "ns" else self.unit

    def shown(self, value: Traced) -> Traced:
        is_time = self.unit == "ns" and isinstance(value, int) and not isinstance(value, bool)
        return value / NS_PER_S if is_time else value  # type: ignore[operator]


@dataclass
class ScanTrace:
    """The rows of a trace, at most `most`. `lost` counts the rows that were overwritten before they were read.

    Times are in seconds since the scan of the trigger, or since the first row. `triggered` is the number of the trigger's row.
    """

    columns: Sequence[TraceColumn]
    most: int
    triggered: int | None = None
    lost: int = 0
    rows: deque[TraceRow] = field(init=False)

    def __post_init__(self) -> None:
        self.rows = deque(maxlen=self.most)

    @property
    def next_row(self) -> int:
        return self.rows[-1].number + 1 if self.rows else 0

    def add(self, row: TraceRow) -> None:
        if self.rows:
            self.lost += row.number - self.next_row
        self.rows.append(row)

    @property
    def zero_ns(self) -> int:
        """Return the time (monotonic) that counts as 0 s."""
        at = next((row for row in self.rows if row.number == self.triggered), None)
        return at.t_ns if at is not None else self.rows[0].t_ns if self.rows else 0

    def column(self, n: int) -> list[Traced]:
        """Return the values of a variable as they are shown."""
        return [self.columns[n].shown(row.values[n]) for row in self.rows]

    def times_s(self) -> list[float]:
        zero = self.zero_ns
        return [(row.t_ns - zero) / NS_PER_S for row in self.rows]

    def table(self) -> Iterator[list[Any]]:
        """Yield the header and the rows: scan, time in seconds, values."""
        yield [
            "scan",
            "time_s",
            *(f"{one.name} [{one.shown_unit}]" if one.shown_unit else one.name for one in self.columns),
        ]
        for t_s, row in zip(self.times_s(), self.rows, strict=True):
            shown = [column.shown(value) for column, value in zip(self.columns, row.values, strict=True)]
            yield [row.scan, f"{t_s:.6f}", *("" if value is None else value for value in shown)]

    def csv(self) -> str:
        """Return the trace as CSV. A text that a spreadsheet would take for a formula begins with an apostrophe."""
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        for row in self.table():
            writer.writerow([f"'{one}" if isinstance(one, str) and one[:1] in "=+@\t" and one else one for one in row])
        return text.getvalue()

    def as_data(self) -> dict[str, Any]:
        """Return the trace as data for JSON."""
        return {
            "variables": [{"name": one.name, "type": one.type, "unit": one.shown_unit} for one in self.columns],
            "triggered_scan": next((row.scan for row in self.rows if row.number == self.triggered), None),
            "lost": self.lost,
            "rows": [
                [
                    row.scan,
                    round(t_s, 9),
                    *(column.shown(v) for column, v in zip(self.columns, row.values, strict=True)),
                ]
                for t_s, row in zip(self.times_s(), self.rows, strict=True)
            ],
        }
