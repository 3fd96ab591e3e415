"""The transitions of a PLC's programs between named states, with their times.

The PLC remembers the latest changes of each tag; they are read when a program's state differs from the last one that was seen.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from typing import Any

import msgspec

from fieldtwin.gateway.core.clock import NS_PER_MS
from fieldtwin.plc.status import WholePlcStatus
from fieldtwin.twin.plant.channel import Channel

MOST_TRANSITIONS = 200
"""Largest number of transitions that are kept of each program; the oldest are dropped first."""


class StateChange(msgspec.Struct, frozen=True):
    """A transition. `t_ns` counts on the run's monotonic clock; `scan` is the number of the scan that made it."""

    t_ns: int
    scan: int
    before: Any
    after: Any
    forced: bool
    place: str
    inputs: dict[str, Any]


class StateHistory:
    """The last transitions of every program of a PLC that has a variable `state`."""

    def __init__(self) -> None:
        self.changes: dict[str, deque[StateChange]] = {}
        self._run: tuple[int, int] = (0, 0)
        """Process ID and number of restarts of the PLC. The PLC counts scans and changes anew after each restart."""
        self._seen: dict[str, Any] = {}
        self._last_scan: dict[str, int] = {}

    @property
    def newest(self) -> dict[str, int]:
        """Return the time of the last transition of each program, in ns."""
        return {program: changes[-1].t_ns for program, changes in self.changes.items() if changes}

    async def look(self, plc: WholePlcStatus, state_tags: Mapping[str, str], channel: Channel, now_ns: int) -> None:
        """Read the transitions since the last call. `state_tags`: by program, the tag that holds its state.

        Raises what `Channel.call` raises.
        """
        if self._run != (plc.pid, plc.restarts):
            self._run = (plc.pid, plc.restarts)
            self._seen, self._last_scan = {}, {}
        for program, tag in state_tags.items():
            value = plc.outputs.get(tag)
            if program in self._seen and self._seen[program] == value:
                continue
            answer = await channel.call("why", tag=tag)
            self._add(program, answer["changes"], now_ns)
            self._seen[program] = value

    def _add(self, program: str, changes: list[dict[str, Any]], now_ns: int) -> None:
        kept = self.changes.setdefault(program, deque(maxlen=MOST_TRANSITIONS))
        last = self._last_scan.get(program, 0)
        for change in reversed(changes):  # the oldest first
            if change["scan"] > last:
                t_ns = now_ns - round(change["age_ms"] * NS_PER_MS)
                rest = {name: change[name] for name in ("scan", "before", "after", "forced", "place", "inputs")}
                kept.append(StateChange(t_ns, **rest))
                self._last_scan[program] = change["scan"]
