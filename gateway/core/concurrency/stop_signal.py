"""Ctrl-C and SIGTERM as an event of the loop."""

from __future__ import annotations

import asyncio
import signal
from collections.abc import Callable


def on_stop_signal(call: Callable[[], object]) -> None:
    """Call `call` in the running loop on each SIGINT and SIGTERM.

    Where the loop has no signal handlers (Windows), SIGINT raises KeyboardInterrupt as usual.
    """
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        try:
            loop.add_signal_handler(number, call)
        except NotImplementedError:
            return


def stop_signal() -> asyncio.Event:
    """Return an event that SIGINT and SIGTERM set from now on.

    Call this before the program announces where it serves: a caller that reads the announcement may send the signal at once.
    """
    stop = asyncio.Event()
    on_stop_signal(stop.set)
    return stop
