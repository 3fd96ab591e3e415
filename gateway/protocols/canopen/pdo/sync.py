"""The SYNC and TIME producers (CiA 301, 7.2.5 and 7.2.6), which determine when each frame is due.

The producers do no I/O: the caller passes the time and sends the frames. The average period is kept even if `due` is called late;
missed frames are skipped and counted, never sent in a burst.
"""

from __future__ import annotations

from typing import Protocol

from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.clock import NS_PER_MS, NS_PER_S
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.gateway.protocols.canopen import cob_id

NS_PER_US = 1_000
_DAY_NS = 24 * 3600 * NS_PER_S
_DAYS_TO_1984 = 5113
"""Days from 1970-01-01 to 1984-01-01, the first day of TIME_OF_DAY (7.1.6.5)."""
COUNTER_MAX = 240


class FrameProducer(Protocol):
    """A producer of periodic frames."""

    name: str
    period_ns: int
    next_ns: int
    missed: int

    def due(self, now_ns: int, utc_ns: int) -> CanFrame | None:
        """Return the frame to send at `now_ns`, or None if it is too early."""
        ...


class _Periodic:
    name = ""

    def __init__(self, period_ns: int, now_ns: int) -> None:
        if period_ns <= 0:
            raise UsageError("the period of a SYNC or TIME producer", expected="more than 0", got=f"{period_ns} ns")
        self.period_ns = period_ns
        self.next_ns = now_ns + period_ns
        self.sent = 0
        self.missed = 0

    def _is_due(self, now_ns: int) -> bool:
        if now_ns < self.next_ns:
            return False
        late = (now_ns - self.next_ns) // self.period_ns
        self.missed += late
        self.next_ns += (late + 1) * self.period_ns
        self.sent += 1
        return True


class SyncProducer(_Periodic):
    """A producer of SYNC every `period_us` (1006h). `overflow` is the counter's highest value (1019h): 2 to 240, or 0 for no
    counter.

    The counter begins with 1 and counts the SYNCs that were sent.
    """

    name = "SYNC"

    def __init__(self, period_us: int, now_ns: int, *, overflow: int = 0, can_id: int = cob_id.SYNC) -> None:
        super().__init__(period_us * NS_PER_US, now_ns)
        if overflow != 0 and not 2 <= overflow <= COUNTER_MAX:
            raise UsageError("the SYNC counter's overflow value", expected="0, or 2 to 240", got=str(overflow))
        self._overflow = overflow
        self._can_id = can_id
        self._counter = 0

    def due(self, now_ns: int, utc_ns: int) -> CanFrame | None:
        if not self._is_due(now_ns):
            return None
        if not self._overflow:
            return CanFrame(self._can_id)
        self._counter = self._counter % self._overflow + 1
        return CanFrame(self._can_id, bytes([self._counter]))


class TimeProducer(_Periodic):
    """A producer of TIME every `period_ms`, with the time of day in UTC.

    While the host's clock is not set, no frame is sent, and it counts as missed."""

    name = "TIME"

    def __init__(self, period_ms: int, now_ns: int, *, can_id: int = cob_id.TIME) -> None:
        super().__init__(period_ms * NS_PER_MS, now_ns)
        self._can_id = can_id

    def due(self, now_ns: int, utc_ns: int) -> CanFrame | None:
        if not self._is_due(now_ns):
            return None
        try:
            return CanFrame(self._can_id, time_of_day(utc_ns))
        except UsageError:  # the host's clock may start in 1970, which must not stop the bus
            self.sent, self.missed = self.sent - 1, self.missed + 1
            return None


def time_of_day(utc_ns: int) -> bytes:
    """Return TIME_OF_DAY (7.1.6.5): milliseconds since midnight in 28 bits, four reserved, days since 1984-01-01 in 16."""
    days, rest_ns = divmod(utc_ns, _DAY_NS)
    since = days - _DAYS_TO_1984
    if not 0 <= since <= 0xFFFF:
        raise UsageError("a time that TIME_OF_DAY can hold", expected="1984 to 2163", got=f"{since} days since 1984")
    return (rest_ns // NS_PER_MS).to_bytes(4, "little") + since.to_bytes(2, "little")
