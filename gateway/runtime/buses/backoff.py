"""The delay before the next request to a device that did not answer. It doubles with each failure, up to a limit."""

from __future__ import annotations


class Backoff:
    """A series of delays in seconds: `first_s`, twice that, and so on up to `limit_s`. Call `reset` after a success."""

    def __init__(self, first_s: float = 0.5, limit_s: float = 10.0) -> None:
        self._first_s = first_s
        self._limit_s = limit_s
        self.failures = 0

    def restate(self, first_s: float, limit_s: float) -> None:
        """Use these delays from the next failure on."""
        self._first_s, self._limit_s = first_s, limit_s

    def next_s(self) -> float:
        """Note a failure, and return the delay before the next attempt, in seconds."""
        delay = min(self._limit_s, self._first_s * 2.0 ** min(self.failures, 20))
        self.failures += 1
        return delay

    def reset(self) -> None:
        self.failures = 0
