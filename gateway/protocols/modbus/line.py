"""The serial line between two exchanges: the silence before a request, and the quarantine after a failed exchange.

On a serial line a reply does not say which request it answers. So after a timeout, or when an exchange was given up, no request
is sent until the line has been silent for as long as the slowest reply so far took (case MB-013). This module does no I/O: the
caller reports the times of sent and received bytes, and gets the time until which it has to wait. Times are monotonic
nanoseconds.
"""

from __future__ import annotations

from fieldtwin.gateway.core.clock import NS_PER_MS, NS_PER_S

TURNAROUND_S = 0.1
"""The time that units get to execute a broadcast (SL 2.4.1: 100 to 200 ms)."""

_LONGEST_LATENCY_NS = 60 * NS_PER_S
"""The longest quarantine, in ns, even if a reply once took longer."""

_BABBLE_FACTOR = 3
_BABBLE_GRACE_NS = 500 * NS_PER_MS
"""The wait for silence fails after `_BABBLE_FACTOR` times the required silence plus this time."""


class LineSilence:
    """The times at which requests may be sent on a line.

    `t35_ns` is the silence between frames (SL 2.5.1.1), or 0. `settle_ns` is the longest time in which the rest of a damaged
    frame may arrive. `quarantines` is true if replies do not identify their request. `turnaround_ns` is the pause after a
    broadcast, and `spacing_ns` the pause after every other exchange, for devices that need one.
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
        """Use these pauses (see the class) from the next exchange on."""
        self._turnaround_ns, self._spacing_ns = turnaround_ns, spacing_ns

    def may_go(self, now_ns: int) -> bool:
        """Return whether a request may be sent now. If so, this ends a quarantine."""
        if self._not_before_ns > now_ns or (
            self._active_ns is not None and self._active_ns + self._required_ns > now_ns
        ):
            return False
        self._in_quarantine = False
        self._required_ns = self._t35_ns
        return True

    def clear_ns(self, now_ns: int) -> int:
        """Return the time at which a request may be sent if no more bytes arrive."""
        silent_ns = now_ns if self._active_ns is None else self._active_ns + self._required_ns
        return max(silent_ns, self._not_before_ns)

    def babble_ns(self, since_ns: int) -> int:
        """Return the time at which to give up waiting for silence, if the wait began at `since_ns`."""
        return max(since_ns, self._not_before_ns) + _BABBLE_FACTOR * self._required_ns + _BABBLE_GRACE_NS

    def babbled(self) -> None:
        """Discard the learned latency, because the received bytes were not a late reply.

        Otherwise every quarantine would be longer than the previous one.
        """
        if self._in_quarantine:
            self.longest_latency_ns, self._required_ns = self._before_quarantine

    def heard(self, now_ns: int, *, live: bool) -> None:
        """Note bytes that arrived between exchanges.

        `live` says that they arrived at `now_ns`, not earlier. During a quarantine such bytes show how late a reply can be.
        """
        self._active_ns = now_ns
        if live and self._in_quarantine:
            self._note_latency(now_ns)
            self._required_ns = max(self._required_ns, self.longest_latency_ns)

    def answered(self, now_ns: int, sent_ns: int) -> None:
        """Note that the reply to the request sent at `sent_ns` was complete at `now_ns`."""
        self._sent_ns = sent_ns
        if now_ns - sent_ns > self.longest_latency_ns:
            self._note_latency(now_ns)
        self._end(now_ns, self._t35_ns)

    def damaged(self, now_ns: int) -> None:
        """Note a reply with a wrong check sum. The rest of this reply may still arrive, but no other reply will."""
        self._end(now_ns, max(self._t35_ns, self._settle_ns))

    def given_up(self, now_ns: int, sent_ns: int, timeout_ns: int) -> None:
        """Note an exchange that timed out, was cancelled, or got a wrong frame. Its reply may still arrive."""
        self._sent_ns = sent_ns
        if self._quarantines:
            self._in_quarantine = True
            self._end(max(now_ns, sent_ns), max(timeout_ns, self.longest_latency_ns, self._settle_ns))
            self._before_quarantine = self.longest_latency_ns, self._required_ns

    def passed_over(self, now_ns: int) -> None:
        """Note that a unit did not answer, without a quarantine: the line stays usable for other units.

        The caller sends the unit no request until its late reply can no longer arrive.
        """
        self._end(now_ns, self._t35_ns)

    def broadcast(self, sent_ns: int) -> None:
        """Note a broadcast: no unit answers it, and the units get time to execute it."""
        self._end(sent_ns, self._t35_ns)
        self._not_before_ns = sent_ns + max(self._turnaround_ns, self._spacing_ns)

    def _end(self, now_ns: int, required_ns: int) -> None:
        self._active_ns = now_ns
        self._required_ns = required_ns
        self._not_before_ns = now_ns + self._spacing_ns

    def _note_latency(self, now_ns: int) -> None:
        self.longest_latency_ns = min(max(self.longest_latency_ns, now_ns - self._sent_ns), _LONGEST_LATENCY_NS)
