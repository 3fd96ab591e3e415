"""A serial line as a model: when a character is on the far side.

Pure arithmetic over integer nanoseconds. It opens nothing, waits for nothing and never sees a byte's value. A pty or an
in-memory wire asks it, because neither is slowed down by the baud rate that is set on it.
"""

from __future__ import annotations

from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.endpoint import SerialSettings

FAST_BAUDRATE = 19200
T1_5_FAST_NS, T3_5_FAST_NS = 750_000, 1_750_000
"""Above 19200 baud the gaps no longer shrink with the character: fixed by SL 2.5.1.1."""


class SerialPacer:
    """One direction of a line with `settings`. Characters go one after another, none is lost, none overtakes.

    All times are monotonic nanoseconds, rounded up: nothing ever arrives early.
    """

    def __init__(self, settings: SerialSettings) -> None:
        self.settings = settings
        self._char = (
            settings.bits_per_char * NS_PER_S,
            settings.baudrate,
        )  # as a fraction, so that nothing is rounded twice
        self.busy_until_ns = 0
        """When the last character that was sent is on the far side; 0 if none was."""

    @property
    def t1_5_ns(self) -> int:
        """The longest pause inside a frame (SL 2.5.1.1)."""
        return T1_5_FAST_NS if self.settings.baudrate > FAST_BAUDRATE else self._half_chars_ns(3)

    @property
    def t3_5_ns(self) -> int:
        """The shortest pause between frames (SL 2.5.1.1)."""
        return T3_5_FAST_NS if self.settings.baudrate > FAST_BAUDRATE else self._half_chars_ns(7)

    def duration_ns(self, nbytes: int) -> int:
        """How long `nbytes` characters take back to back."""
        numerator, denominator = self._char
        return -(-nbytes * numerator // denominator)

    def earliest_end(self, now_ns: int, nbytes: int) -> int:
        """When `nbytes` handed over at `now_ns` would be on the far side, behind what is on its way. Books nothing."""
        busy_ns = self.busy_until_ns
        return (now_ns if now_ns > busy_ns else busy_ns) + self.duration_ns(nbytes)

    def send(self, now_ns: int, nbytes: int) -> int:
        """Like `earliest_end`, and the line is taken until then."""
        busy_ns = self.busy_until_ns
        numerator, denominator = self._char
        self.busy_until_ns = end_ns = (now_ns if now_ns > busy_ns else busy_ns) - (-nbytes * numerator // denominator)
        return end_ns

    def _half_chars_ns(self, count: int) -> int:
        numerator, denominator = self._char
        return -(-count * numerator // (2 * denominator))
