"""Signals between two callbacks of a virtual loop, and not in the midst of one.

What a signal's handler raises comes out of whatever line runs at that moment. Where that is a line that asyncio called to wake a
task, the task is never woken, and nothing can end it in order any more. So SIGINT and SIGTERM wait until the callback is
over. A second one does not wait: it may never be. Nor does the first one wait longer than `PATIENCE_S` of computing.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable
from types import FrameType
from typing import Any, Self

HELD_BACK = (signal.SIGINT, signal.SIGTERM)
PATIENCE_S = 1.0
"""Processor time that a callback may still take after a signal came. A loop without an end takes more."""

Handler = Callable[[int, FrameType | None], object]


class Interrupts:
    """While entered, `stop` is called at once for a signal that has a handler of Python's, and the handler by `deliver`.

    Outside of the main thread, which is the only one that signals come to, it does nothing.
    """

    def __init__(self, stop: Callable[[], None]) -> None:
        self._stop = stop
        self._handlers: dict[int, Handler] = {}
        self._waiting: int | None = None
        self._alarm_before: Callable[[int, FrameType | None], Any] | int | None = None

    def __enter__(self) -> Self:
        if threading.get_ident() == threading.main_thread().ident:
            for number in HELD_BACK:
                handler = signal.getsignal(number)
                if callable(handler):
                    self._handlers[number] = handler
                    signal.signal(number, self._heard)
            if self._handlers:
                self._alarm_before = signal.signal(signal.SIGVTALRM, self._on_alarm)
        return self

    def __exit__(self, *exc_info: object) -> None:
        for number, handler in self._handlers.items():
            signal.signal(number, handler)
        if self._handlers:
            signal.setitimer(signal.ITIMER_VIRTUAL, 0)
            signal.signal(signal.SIGVTALRM, self._alarm_before)
        if exc_info[0] is None:
            self.deliver()  # it came with the last callback

    def _heard(self, number: int, frame: FrameType | None) -> None:
        if self._waiting is not None:
            self._handlers[number](number, frame)
            return
        self._waiting = number
        self._stop()
        signal.setitimer(signal.ITIMER_VIRTUAL, PATIENCE_S)

    def _on_alarm(self, number: int, frame: FrameType | None) -> None:
        if self._waiting is not None:
            self._handlers[self._waiting](self._waiting, frame)

    def deliver(self) -> None:
        """Call the handler of a signal that came, if one did: it raises as a rule."""
        number, self._waiting = self._waiting, None
        if number is not None:
            signal.setitimer(signal.ITIMER_VIRTUAL, 0)
            self._handlers[number](number, None)
