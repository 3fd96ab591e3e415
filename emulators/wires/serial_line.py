"""A model of a serial line: when a character has arrived at the receiver.

The model computes times in integer nanoseconds. It opens no port, never waits, and does not need the values of the bytes. Ptys
and in-memory connections use it, because they themselves ignore the configured baud rate.
"""

from __future__ import annotations

from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.endpoint import SerialSettings

FAST_BAUDRATE = 19200
T1_5_FAST_NS, T3_5_FAST_NS = 750_000, 1_750_000
"""The gaps above 19200 baud, where SL 2.5.1.1 gives fixed times instead of character times."""


class SerialPacer:
    """One direction of a line with `settings`. Characters are sent one after the other; none is lost or overtakes another.

    All times are monotonic nanoseconds, rounded up: nothing ever arrives early.
    """

    def __init__(self, settings: SerialSettings) -> None:
        self.settings = settings
        self._char = (
            settings.bits_per_char * NS_PER_S,
            settings.baudrate,
        )  # as a fraction, so that a result is rounded only once
        self.busy_until_ns = 0
        """The time at which the last character that was sent arrives; 0 if none was sent."""

    @property
    def t1_5_ns(self) -> int:
        """Return the longest pause inside a frame (SL 2.5.1.1)."""
        return T1_5_FAST_NS if self.settings.baudrate > FAST_BAUDRATE else self._half_chars_ns(3)

    @property
    def t3_5_ns(self) -> int:
        """Return the shortest pause between frames (SL 2.5.1.1)."""
        return T3_5_FAST_NS if self.settings.baudrate > FAST_BAUDRATE else self._half_chars_ns(7)

    def duration_ns(self, nbytes: int) -> int:
        """Return the duration of `nbytes` characters without gaps, in ns."""
        numerator, denominator = self._char
        return -(-nbytes * numerator // denominator)

    def earliest_end(self, now_ns: int, nbytes: int) -> int:
        """Return the time at which `nbytes` that are sent at `now_ns` would have arrived, after the characters in transit.

        Does not occupy the line.
        """
        busy_ns = self.busy_until_ns
        return (now_ns if now_ns > busy_ns else busy_ns) + self.duration_ns(nbytes)

    def send(self, now_ns: int, nbytes: int) -> int:
        """Occupy the line with `nbytes` and return the time at which they have arrived, see `earliest_end`."""
        busy_ns = self.busy_until_ns
        numerator, denominator = self._char
        self.busy_until_ns = end_ns = (now_ns if now_ns > busy_ns else busy_ns) - (-nbytes * numerator // denominator)
        return end_ns

    def _half_chars_ns(self, count: int) -> int:
        numerator, denominator = self._char
        return -(-count * numerator // (2 * denominator))
