"""Whether more than one producer sends SYNC on a bus (CiA 301, 7.2.5: there is one).

All SYNCs have one identifier, so that nothing in a frame names its producer. A second one shows by a SYNC that arrives while we
produce it ourselves, by counters (1019h) that are out of order, by intervals that are short and long in turn, or by SYNCs that
come more often than the communication cycle period (1006h) says. Where that period is not known, two producers without counters
whose SYNCs are evenly spaced look like one producer with half the period; listening cannot tell them apart. Pure.
"""

from __future__ import annotations

from collections import deque

from fieldtwin.gateway.core.clock import NS_PER_MS

_INTERVALS = 16
"""Intervals that are compared: enough that a few late frames do not matter."""
_APART = 2.0
"""How much longer the long quarter of the intervals is than the short one, of two producers."""
_TOO_OFTEN = 1.5
"""How many SYNCs come in one communication cycle, of two producers: 2, less what clocks and a busy bus take away."""
_OUT_OF_ORDER = 3
"""Counters out of order: a producer that restarted makes one."""


class SyncWatch:
    """Feed it each SYNC that was received. `own`: this master produces SYNC, so that any other producer is one too many.
    `period_ns`: the communication cycle period, 0 where it is not known."""

    def __init__(self, *, own: bool = False, period_ns: int = 0) -> None:
        self._own = own
        self._period_ns = period_ns
        self._last_ns: int | None = None
        self._last_counter = 0
        self._jumps = 0
        self._intervals: deque[int] = deque(maxlen=_INTERVALS)
        self.seen = 0
        self.verdict = ""
        """Why there is more than one producer, in words; empty while there is no sign of a second one. It stays once found."""

    def feed(self, data: bytes, t_ns: int) -> None:
        """A SYNC came at `t_ns`; `data` is empty, or its counter."""
        self.seen += 1
        if self._last_ns is not None:
            self._intervals.append(t_ns - self._last_ns)
        self._last_ns = t_ns
        if len(data) == 1:
            expected = (0, self._last_counter + 1, 1)  # unknown, next, or begun again
            if self._last_counter and data[0] not in expected:
                self._jumps += 1
            self._last_counter = data[0]
        self.verdict = self.verdict or self._judge()

    def _judge(self) -> str:
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
        """SYNC comes at even intervals; whether they are shorter than the cycle."""
        mean_ns = sum(self._intervals) / len(self._intervals)
        if not self._period_ns or mean_ns <= 0 or self._period_ns / mean_ns < _TOO_OFTEN:
            return ""
        return (
            f"SYNC comes every {mean_ns / NS_PER_MS:.3g} ms, and the communication cycle period is "
            f"{self._period_ns / NS_PER_MS:.6g} ms: there seem to be {round(self._period_ns / mean_ns)} producers, or one with a "
            "shorter period"
        )
