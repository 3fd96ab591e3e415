"""The probing of devices that do not answer: with shortened timeouts, and within a budget, while other devices answer.

A *probe* is one request to a device that is away or was never contacted. While another device of the bus answers,

* a probe waits no longer than four times the longest of the latest replies on the bus, at least `LEAST_NS` and twice the
  silence of 3.5 characters, at most the device's own timeout. A device whose reply came too late once gets twice the time
  that the reply took;
* a probe that ends before any group could miss its period takes at most `share` of the bus's time, after a burst of
  `BURST_NS`;
* a probe that cannot end that soon takes at most `share` / `LONG_PART`. Such probes give a device its own timeout, after
  three that were shortened.

While no device answers, the timeout doubles with each failure until it is the device's own, so that devices that can answer are
found soon. A device that is alone on its bus always gets its own timeout. This module does no I/O. Times are monotonic
nanoseconds, which the caller passes.
"""

from __future__ import annotations

from fieldtwin.gateway.core.clock import NS_PER_MS, NS_PER_S

LEAST_NS = 50 * NS_PER_MS
"""The shortest timeout. A USB adapter alone may delay a reply by 16 ms."""
PATIENCE = 4
"""A probe waits for this multiple of the longest latency seen lately."""
LATE_PATIENCE = 2
"""A device that answered too late gets this multiple of the time that its reply took."""
MARGIN_NS = 20 * NS_PER_MS
"""The duration of a probe in addition to its timeout: request, silences, and delays of the host."""
BURST_NS = 3 * NS_PER_S
"""Probing time that may be spent in one burst, for instance on the first contact with all devices: 5 % of a minute."""
LONG_PART = 8
"""Probes that make other devices miss polls get the share divided by this."""
SHORT_TRIES = 3
"""The number of probes with a shortened timeout before a device is probed with its own timeout."""


class Probing:
    """The budget of one bus. `share`, which is above 0 and at most 1, is the part of the bus's time for probes."""

    def __init__(self, share: float, t35_ns: int) -> None:
        self._share = share
        self._least_ns = max(LEAST_NS, 2 * t35_ns)
        self._spent_until_ns = 0
        """The time until which the probes so far have used up the share of the bus."""
        self._long_ns = 0
        """The earliest time of the next probe that makes other devices miss polls."""

    def restate(self, share: float) -> None:
        """Set a new share, from the next probe on."""
        self._share = share

    def short_ns(self, own_ns: int, seen_ns: int, late_ns: int) -> int:
        """Return the shortened timeout of a device whose own timeout is `own_ns`.

        `seen_ns` is the longest latency seen lately on the bus, `late_ns` the duration of a late reply of the device;
        0: none.
        """
        return min(own_ns, max(self._least_ns, PATIENCE * seen_ns, LATE_PATIENCE * late_ns))

    def growing_ns(self, own_ns: int, seen_ns: int, late_ns: int, failures: int) -> int:
        """Return the timeout after `failures` failures while no device answers."""
        return min(own_ns, self.short_ns(own_ns, seen_ns, late_ns) << min(failures, 20))

    def long_may_go(self, failures: int, now_ns: int) -> bool:
        """Return whether a device with this number of failures should now be probed with its own, long timeout."""
        return failures >= SHORT_TRIES and now_ns >= self._long_ns

    def fits(self, cost_ns: int, now_ns: int, free_until_ns: int) -> bool:
        """Return whether a probe that may take `cost_ns` ends before a group could miss its period."""
        return now_ns + cost_ns <= free_until_ns

    def may_go_ns(self, fits: bool, now_ns: int) -> int:
        """Return the time at which a probe may start: now, or when the budget allows it."""
        paid_ns = self._spent_until_ns - int(BURST_NS / self._share)
        return max(now_ns, paid_ns, 0 if fits else self._long_ns)

    def took(self, begun_ns: int, end_ns: int, fitted: bool) -> None:
        """Charge a failed use of the bus from `begun_ns` to `end_ns` to the budget.

        `fitted` says that no group missed its period.
        """
        spent_ns = end_ns - begun_ns
        self._spent_until_ns = max(self._spent_until_ns, begun_ns) + int(spent_ns / self._share)
        if not fitted:
            self._long_ns = max(self._long_ns, end_ns + int(spent_ns * (LONG_PART / self._share - 1)))
