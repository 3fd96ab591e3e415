"""The line between two exchanges: silence before a request, and quarantine after an exchange that ended badly.

On a serial line a reply does not say which request it answers. So after a timeout, or when an exchange was given up, the
line is held until nothing has come for as long as the slowest reply ever took (case MB-013); only then may the next
request go. Pure: told what arrived and when, it says until when to wait. Times are monotonic nanoseconds.
"""

from __future__ import annotations

from fieldtwin.gateway.core.clock import NS_PER_MS, NS_PER_S

TURNAROUND_S = 0.1
"""What units get to execute a broadcast (SL 2.4.1: 100 to 200 ms)."""

_LONGEST_LATENCY_NS = 60 * NS_PER_S
"""No quarantine is longer, whatever once came late."""

_BABBLE_FACTOR = 3
_BABBLE_GRACE_NS = 500 * NS_PER_MS
"""A line that is not silent within this many of the silences required, and a little more, is reported."""


class LineSilence:
    """`t35_ns`: the silence between frames (SL 2.5.1.1), 0 where there is none. `settle_ns`: how late the rest of a
    damaged frame may come. `quarantines`: whether replies cannot be told apart. `turnaround_ns`: the pause behind a
    request that nobody answers. `spacing_ns`: the pause behind every other exchange, for devices that need one.
    """

    def __init__(
        self,
        *,
        t35_ns: int,
        settle_ns: int,
        quarantines: bool,
        turnaround_ns: int = round(TURNAROUND_S * NS_PER_S),
        spacing_ns: int = 0,
    ) -> None:
        self._turnaround_ns = turnaround_ns
        self._spacing_ns = spacing_ns
        self._t35_ns = t35_ns
        self._settle_ns = settle_ns
        self._quarantines = quarantines
        self._required_ns = 0
        self._active_ns: int | None = None
        self._not_before_ns = 0
        self._sent_ns = 0
        self._in_quarantine = False
        self.longest_latency_ns = 0
        self._before_quarantine = (0, 0)

    def restate(self, *, turnaround_ns: int, spacing_ns: int) -> None:
        """Other pauses from the next exchange on."""
        self._turnaround_ns, self._spacing_ns = turnaround_ns, spacing_ns

    def may_go(self, now_ns: int) -> bool:
        """Whether a request may go now, if nothing arrived since; the quarantine, if there was one, is over then."""
        if self._not_before_ns > now_ns or (
            self._active_ns is not None and self._active_ns + self._required_ns > now_ns
        ):
            return False
        self._in_quarantine = False
        self._required_ns = self._t35_ns
        return True

    def clear_ns(self, now_ns: int) -> int:
        """When a request may go if nothing arrives any more."""
        silent_ns = now_ns if self._active_ns is None else self._active_ns + self._required_ns
        return max(silent_ns, self._not_before_ns)

    def babble_ns(self, since_ns: int) -> int:
        """From when on, if silence was awaited since `since_ns`, bytes mean that the line will not become silent."""
        return max(since_ns, self._not_before_ns) + _BABBLE_FACTOR * self._required_ns + _BABBLE_GRACE_NS

    def babbled(self) -> None:
        """What was heard was no late reply: unlearn the latency, or every quarantine would be longer than the last."""
        if self._in_quarantine:
            self.longest_latency_ns, self._required_ns = self._before_quarantine

    def heard(self, now_ns: int, *, live: bool) -> None:
        """Bytes arrived between exchanges. `live`: they arrived just now, so they tell how late a reply can be."""
        self._active_ns = now_ns
        if live and self._in_quarantine:
            self._note_latency(now_ns)
            self._required_ns = max(self._required_ns, self.longest_latency_ns)

    def answered(self, now_ns: int, sent_ns: int) -> None:
        """A reply came, complete at `now_ns`, to the request that had left at `sent_ns`."""
        self._sent_ns = sent_ns
        if now_ns - sent_ns > self.longest_latency_ns:
            self._note_latency(now_ns)
        self._end(now_ns, self._t35_ns)

    def damaged(self, now_ns: int) -> None:
        """The reply came and its check sum was wrong: there is no other one, but its rest may follow."""
        self._end(now_ns, max(self._t35_ns, self._settle_ns))

    def given_up(self, now_ns: int, sent_ns: int, timeout_ns: int) -> None:
        """Timed out, cancelled, or answered by the wrong frame: the reply may still come."""
        self._sent_ns = sent_ns
        if self._quarantines:
            self._in_quarantine = True
            self._end(max(now_ns, sent_ns), max(timeout_ns, self.longest_latency_ns, self._settle_ns))
            self._before_quarantine = self.longest_latency_ns, self._required_ns

    def passed_over(self, now_ns: int) -> None:
        """Nothing came from a unit that is not asked again before its reply can no longer come: others may use the line."""
        self._end(now_ns, self._t35_ns)

    def broadcast(self, sent_ns: int) -> None:
        """Nobody answers; the units get time to execute."""
        self._end(sent_ns, self._t35_ns)
        self._not_before_ns = sent_ns + max(self._turnaround_ns, self._spacing_ns)

    def _end(self, now_ns: int, required_ns: int) -> None:
        self._active_ns = now_ns
        self._required_ns = required_ns
        self._not_before_ns = now_ns + self._spacing_ns

    def _note_latency(self, now_ns: int) -> None:
        self.longest_latency_ns = min(max(self.longest_latency_ns, now_ns - self._sent_ns), _LONGEST_LATENCY_NS)
