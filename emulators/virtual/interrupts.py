"""Deliver signals between two callbacks of a virtual loop, and never during a callback.

The exception of a signal handler is raised in the line that is being executed. If that line was to wake a task, the task is never
woken and can no longer be ended in order. SIGINT and SIGTERM therefore wait until the callback is over, but at most `PATIENCE_S`
of computing time. A second signal does not wait, because the callback may never end.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable
from types import FrameType
from typing import Any, Self

HELD_BACK = (signal.SIGINT, signal.SIGTERM)
PATIENCE_S = 1.0
"""The processor time in seconds that a callback may still take after a signal has arrived. After that the signal is
delivered, because the callback may be an endless loop.
"""

Handler = Callable[[int, FrameType | None], object]


class Interrupts:
    """A context manager that defers signals: a signal with a Python handler calls `stop`, and `deliver` later calls the handler.

    Only the main thread receives signals, so it does nothing in other threads.
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
            self.deliver()  # the signal came during the last callback

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
        """Call the handler of a signal that has arrived, if any; usually it raises."""
        number, self._waiting = self._waiting, None
        if number is not None:
            signal.setitimer(signal.ITIMER_VIRTUAL, 0)
            self._handlers[number](number, None)
