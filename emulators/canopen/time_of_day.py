"""TIME: consumer and producer of the network's time of day (CiA 301 v4.2, 7.2.6; 1012h).

TIME has six bytes: milliseconds after midnight in 28 bits, and days since 1 January 1984 in 16. The node's own clock shows the
last time that was received or set, plus the time elapsed since then. The producer sends every `period_ns`; 0: never.
"""

from __future__ import annotations

from dataclasses import dataclass

from fieldtwin.emulators.canopen.aborts import Abort, abort
from fieldtwin.emulators.canopen.service import NEVER, Core, NodeService
from fieldtwin.gateway.core.clock import NS_PER_MS

COB_ID = 0x1012
_CONSUMES, _PRODUCES = 1 << 31, 1 << 30
_MS_PER_DAY = 86_400_000
_SIZE = 6


@dataclass(frozen=True, slots=True)
class TimeOfDay:
    """A time of day: `days` since 1 January 1984, and milliseconds after midnight."""

    days: int
    ms: int

    def to_bytes(self) -> bytes:
        """Return the six bytes of TIME_OF_DAY."""
        return self.ms.to_bytes(4, "little") + self.days.to_bytes(2, "little")

    @classmethod
    def from_bytes(cls, raw: bytes) -> TimeOfDay:
        """Return the time in `raw`. The upper 4 of the 32 bits are reserved and ignored."""
        return cls(int.from_bytes(raw[4:6], "little"), int.from_bytes(raw[:4], "little") & 0x0FFFFFFF)

    def later(self, ms: int) -> TimeOfDay:
        """Return the time of day `ms` milliseconds later."""
        total = self.days * _MS_PER_DAY + self.ms + ms
        return TimeOfDay(total // _MS_PER_DAY & 0xFFFF, total % _MS_PER_DAY)


class TimeService(NodeService):
    """The node's time of day; None until it has been set or received."""

    due_ns: int = NEVER
    """The time at which the node sends the next TIME."""

    def __init__(self, core: Core, period_ns: int) -> None:
        self._core = core
        self._period_ns = period_ns
        self._known: tuple[TimeOfDay, int] | None = None

    def now(self, now_ns: int) -> TimeOfDay | None:
        """Return the time of day at `now_ns`."""
        if self._known is None:
            return None
        known, at_ns = self._known
        return known.later((now_ns - at_ns) // NS_PER_MS)

    def set_time(self, time: TimeOfDay, now_ns: int) -> None:
        """Set the clock."""
        self._known = (time, now_ns)
        self._core.note(now_ns, "time", COB_ID, 0, time.to_bytes())
        self._schedule(now_ns)

    @property
    def waits(self) -> bool:
        return bool(self._period_ns)

    def owns(self, index: int) -> bool:
        return index == COB_ID

    def check_write(self, index: int, subindex: int, raw: bytes) -> None:
        new, old = int.from_bytes(raw, "little"), self._core.data.number(COB_ID)
        moved = (new ^ old) & 0x7FF and old & (_CONSUMES | _PRODUCES)
        if new & 0x3FFFF800 or moved:
            raise abort(index, subindex, Abort.VALUE)

    def wrote(self, index: int, subindex: int, now_ns: int) -> None:
        self._schedule(now_ns)

    def reset(self, now_ns: int) -> None:
        self._schedule(now_ns)

    def receive(self, can_id: int, data: bytes, now_ns: int) -> bool:
        """Process a data frame. Returns whether it is the TIME that the node consumes, valid or not."""
        cob_id = self._core.data.number(COB_ID)
        if not cob_id & _CONSUMES or can_id != cob_id & 0x7FF:
            return False
        if not self._core.communicating or len(data) != _SIZE:
            self._core.counters.ignored += 1
        else:
            self.set_time(TimeOfDay.from_bytes(data), now_ns)
        return True

    def tick(self, now_ns: int) -> None:
        if now_ns < self.due_ns:
            return
        due_ns = self.due_ns + self._period_ns
        # skip messages that are overdue, and never send several at once
        self.due_ns = due_ns if due_ns > now_ns else now_ns + self._period_ns
        time = self.now(now_ns)
        if time is not None and self._core.communicating:
            self._core.send(self._core.data.number(COB_ID) & 0x7FF, time.to_bytes(), now_ns)

    def _schedule(self, now_ns: int) -> None:
        producing = self._period_ns and self._known and self._core.data.number(COB_ID) & _PRODUCES
        self.due_ns = now_ns + self._period_ns if producing else NEVER
