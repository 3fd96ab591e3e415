"""The timing of a client's units: the timeout and the pause of each, shortened timeouts, and replies that may still arrive.

This module does no I/O. Times are monotonic nanoseconds, which the caller passes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.errors import UsageError


@dataclass(frozen=True, slots=True)
class UnitPace:
    """The timing of one unit: its timeout, and the pause that it needs. It applies to all users of the client.

    If `timeout_s` is None, the timeout of the client applies. The pause is the time from the end of an exchange with the unit to
    the next request for it; other units may use the line meanwhile. Both are in seconds.
    """

    timeout_s: float | None = None
    spacing_s: float = 0.0

    def __post_init__(self) -> None:
        if self.timeout_s is not None:
            checked_timeout(self.timeout_s)
        checked_pause(self.spacing_s)


class Hold(NamedTuple):
    """A unit that did not answer within a shortened timeout.

    The request was sent at `sent_ns`; its reply may arrive until `until_ns`.
    """

    sent_ns: int
    until_ns: int


class UnitTiming:
    """The timing of the units of one client.

    `timeout_s` is the timeout in seconds of a unit without its own, and `has_broadcast` says whether unit 0 addresses all units.
    """

    def __init__(self, timeout_s: float, *, has_broadcast: bool) -> None:
        self._timeout_s = checked_timeout(timeout_s)
        self._has_broadcast = has_broadcast
        self._paces: dict[int, UnitPace] = {}
        self.have_pauses = False
        """Whether at least one unit needs pauses."""
        self.spaced: dict[int, int] = {}
        """By unit ID: the end of its pause, in ns."""
        self._timeouts_ns: dict[int, int] = {}
        """Timeouts by unit ID, in ns; kept until the timing is changed."""
        self.shortened_ns: dict[int, int] = {}
        """By unit ID: the shortened timeout, in ns."""
        self.held: dict[int, Hold] = {}
        """By unit ID: the request whose reply may still arrive."""
        self.late_ns: dict[int, int] = {}
        """By unit ID: the time in ns until a reply arrived after its shortened timeout. The code that shortens timeouts
        removes the entries.
        """
        self.shortened_timeouts = 0
        """The number of timeouts of units whose timeout was shortened. `ClientCounters.timeouts` includes them."""
        self.not_waited = 0.0
        """The sum of the time saved by shortened timeouts, each as a fraction of the unit's normal timeout."""

    def restate(self, timeout_s: float) -> None:
        """Change the timeout of the units without their own, in seconds."""
        self._timeout_s = checked_timeout(timeout_s)
        self._timeouts_ns.clear()

    def set_pace(self, unit: int, pace: UnitPace) -> None:
        """Use this timing for `unit` (0 to 255) from now on."""
        self._paces[unit] = pace
        self._timeouts_ns.clear()
        self.have_pauses = self.have_pauses or bool(pace.spacing_s)

    def timeout_ns(self, unit: int) -> int:
        """Return the normal timeout of `unit` in ns."""
        timeout_ns = self._timeouts_ns.get(unit)
        if timeout_ns is None:
            timeout_ns = self._timeouts_ns[unit] = round(self._timeout_of(unit) * NS_PER_S)
        return timeout_ns

    def shorten_timeout(self, unit: int, timeout_s: float) -> None:
        """Shorten the timeout of `unit` to `timeout_s`, and let other units use the line while its reply is outstanding.

        This ends with the first reply of `unit`, or with `restore_timeout`. Without a reply, the next request to `unit` waits
        until its normal timeout is also over, because a late reply does not say which request it answers (case MB-013).
        """
        self.shortened_ns[unit] = round(checked_timeout(timeout_s) * NS_PER_S)

    def restore_timeout(self, unit: int) -> None:
        """Restore the normal timeout of `unit`."""
        self.shortened_ns.pop(unit, None)

    def is_shortened(self, unit: int) -> bool:
        """Return whether the timeout of `unit` is shortened and the unit has not answered since then."""
        return unit in self.shortened_ns

    def spaced_ns(self, unit: int) -> int:
        """Return the time (ns) from which a request may be sent to `unit`, or 0 if it needs no pause.

        At that time its pause is over, and a late reply can no longer arrive. A broadcast (unit 0) waits for the pauses of all
        units.
        """
        if unit == 0 and self._has_broadcast:
            return max(self.spaced.values(), default=0)
        spaced_ns, hold = self.spaced.get(unit, 0), self.held.get(unit)
        return spaced_ns if hold is None else max(spaced_ns, hold.until_ns)

    def used(self, unit: int, now_ns: int) -> None:
        """Start the pause of `unit` after an exchange that ended at `now_ns`; after a broadcast, the pauses of all units."""
        everybody = unit == 0 and self._has_broadcast
        for one in self._paces if everybody else (unit,):
            pace = self._paces.get(one)
            if pace is not None and pace.spacing_s:
                self.spaced[one] = now_ns + round(pace.spacing_s * NS_PER_S)

    def pass_over(self, unit: int, sent_ns: int, now_ns: int, timeout_ns: int, latency_ns: int) -> None:
        """Note that `unit` did not answer within its shortened `timeout_ns`: delay its next request; other units can use the
        line.

        The request was sent at `sent_ns`; `latency_ns` is the longest response time on the line so far.
        """
        own_ns = round(self._timeout_of(unit) * NS_PER_S)
        self.shortened_timeouts += 1
        self.not_waited += max(0.0, 1.0 - timeout_ns / own_ns)
        # As long as the quarantine of a line after a normal timeout: a late reply must not answer the next request (MB-013).
        until_ns = max(now_ns, sent_ns + own_ns) + max(own_ns, latency_ns)
        self.held[unit] = Hold(sent_ns, until_ns)

    def note_strays(self, strays: dict[int, int], now_ns: int) -> None:
        """Note late replies of units with a shortened timeout: such a unit answers, and its reply is no longer outstanding."""
        for unit, t_ns in strays.items():
            hold = self.held.pop(unit, None)
            if hold is not None:
                self.late_ns[unit] = (t_ns or now_ns) - hold.sent_ns
        strays.clear()

    def _timeout_of(self, unit: int) -> float:
        pace = self._paces.get(unit)
        return self._timeout_s if pace is None or pace.timeout_s is None else pace.timeout_s


def checked_timeout(timeout_s: float) -> float:
    """Return `timeout_s`. Raises `UsageError` unless it is above 0 and at most 3600 s."""
    if not 0.0 < timeout_s <= 3600.0:
        raise UsageError("Modbus timeout out of range", expected="over 0 to 3600 s", got=f"{timeout_s} s")
    return timeout_s


def checked_pause(pause_s: float) -> float:
    """Return `pause_s`. Raises `UsageError` if it is outside of 0 to 3600 s."""
    if not 0.0 <= pause_s <= 3600.0:
        raise UsageError("Modbus pause out of range", expected="0 to 3600 s", got=f"{pause_s} s")
    return pause_s
