"""Detect whether more than one producer sends SYNC on a bus (CiA 301, 7.2.5 allows only one).

All SYNCs have one identifier, so a frame does not name its producer. A second producer is detected by a SYNC that
arrives while this master produces SYNC, by counters (1019h) that are out of order, by intervals that are alternately
short and long, or by SYNCs that are more frequent than the communication cycle period (1006h) allows. If that period is
not known, two producers without counters whose SYNCs are evenly spaced look like one producer with half the period;
listening cannot tell them apart. This module does no I/O.
"""

from __future__ import annotations

from collections import deque

from fieldtwin.gateway.core.clock import NS_PER_MS

_INTERVALS = 16
"""The number of intervals that are compared, so large that a few late frames do not change the result."""
_APART = 2.0
"""The ratio of the long to the short intervals (upper to lower quartile) above which there are two producers."""
_TOO_OFTEN = 1.5
"""The number of SYNCs per communication cycle from which there are two producers: 2, less a margin for clocks and a busy bus."""
_OUT_OF_ORDER = 3
"""The number of counters out of order that prove a second producer. A single one may be caused by a restart of a producer."""


class SyncWatch:
    """A detector of a second SYNC producer. Pass each received SYNC to `feed`.

    `own` says that this master produces SYNC, so that any other producer is a second one. `period_ns` is the
    communication cycle period, 0 if it is not known.
    """

    def __init__(self, *, own: bool = False, period_ns: int = 0) -> None:
        self._own = own
        self._period_ns = period_ns
        self._last_ns: int | None = None
        self._last_counter = 0
        self._jumps = 0
        self._intervals: deque[int] = deque(maxlen=_INTERVALS)
        self.seen = 0
        self.verdict = ""
        """A text with the evidence for a second producer; empty while there is none. Once set, it does not change."""

    def feed(self, data: bytes, t_ns: int) -> None:
        """Note a SYNC that arrived at `t_ns`; `data` is empty, or its counter."""
        self.seen += 1
        if self._last_ns is not None:
            self._intervals.append(t_ns - self._last_ns)
        self._last_ns = t_ns
        if len(data) == 1:
            expected = (0, self._last_counter + 1, 1)  # unknown, next, or restarted
            if self._last_counter and data[0] not in expected:
                self._jumps += 1
            self._last_counter = data[0]
        self.verdict = self.verdict or self._evidence()

    def _evidence(self) -> str:
        if self._own:
            return "a SYNC came from another node, and this master produces SYNC: there are two producers"
        if self._jumps >= _OUT_OF_ORDER:
            return f"{self._jumps} SYNC counters came out of order: there seem to be two producers"
        if len(self._intervals) < _INTERVALS:
            return ""
        ordered = sorted(self._intervals)
        short, long = ordered[_INTERVALS // 4], ordered[-_INTERVALS // 4 - 1]
        if long <= _APART * short:
            return self._too_often()
        times = f"{short / NS_PER_MS:.3g} and {long / NS_PER_MS:.3g} ms"
        return f"SYNC comes at intervals of {times} in turn: there seem to be two producers"

    def _too_often(self) -> str:
        """Return a text if SYNCs at even intervals are more frequent than the cycle period allows, else an empty text."""
        mean_ns = sum(self._intervals) / len(self._intervals)
        if not self._period_ns or mean_ns <= 0 or self._period_ns / mean_ns < _TOO_OFTEN:
            return ""
        return (
            f"SYNC comes every {mean_ns / NS_PER_MS:.3g} ms, and the communication cycle period is "
            f"{self._period_ns / NS_PER_MS:.6g} ms: there seem to be {round(self._period_ns / mean_ns)} producers, or one with a "
            "shorter period"
        )
