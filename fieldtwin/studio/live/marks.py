"""Marks on the time axis: faults that begin and end, values that are set and released, and changes of programs' states."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from typing import Any

import msgspec

from fieldtwin.plc.runtime.about import STATE
from fieldtwin.studio.live.state_history import StateHistory
from fieldtwin.twin.prototype.field_status import FieldStatus

MOST_MARKS = 1_000
"""Largest number of faults and set values that are kept; the oldest are dropped first."""


class Mark(msgspec.Struct, frozen=True):
    """An event at an instant on the run's monotonic clock. `kind`: ``fault``, ``cleared`` or ``state``."""

    t_ns: int
    kind: str
    text: str


class FaultMarks:
    """The times at which faults and set values appeared and disappeared, as the status of the simulated devices showed them."""

    def __init__(self) -> None:
        self.marks: deque[Mark] = deque(maxlen=MOST_MARKS)
        self._active: dict[str, str] = {}

    def look(self, status: FieldStatus, now_ns: int) -> None:
        """Compare a status with the previous one, and record the differences as marks at `now_ns`."""
        active = {fault.id: f"{fault.name} on {fault.device or fault.bus}" for fault in status.faults}
        active |= {f"set {tag} {value:g}": f"{tag} set to {value:g}" for tag, value in status.set.items()}
        self.marks += [Mark(now_ns, "cleared", text) for key, text in self._active.items() if key not in active]
        self.marks += [Mark(now_ns, "fault", text) for key, text in active.items() if key not in self._active]
        self._active = active


def all_marks(faults: FaultMarks, states: StateHistory, programs: Mapping[str, Any]) -> list[Mark]:
    """Return the marks of faults and of states, the oldest first."""
    found = list(faults.marks)
    for program, changes in states.changes.items():
        described = programs.get(program, {"variables": {}})["variables"].get(STATE)
        words = described["words"] if described else {}
        for change in changes:
            before, after = (words.get(str(value), str(value)) for value in (change.before, change.after))
            found.append(Mark(change.t_ns, "state", f"{program}: {before} → {after}"))
    return sorted(found, key=lambda mark: mark.t_ns)
