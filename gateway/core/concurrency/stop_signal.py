"""Turn Ctrl-C and SIGTERM into an event of the asyncio loop."""

from __future__ import annotations

import asyncio
import signal
from collections.abc import Callable


def on_stop_signal(call: Callable[[], object]) -> None:
    """Call `call` in the running loop on each SIGINT and SIGTERM.

    If the loop supports no signal handlers (Windows), SIGINT raises KeyboardInterrupt as usual.
    """
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        try:
            loop.add_signal_handler(number, call)
        except NotImplementedError:
            return


def stop_signal() -> asyncio.Event:
    """Return an event that SIGINT and SIGTERM set from now on.

    Call this before the program prints its endpoint: a parent process that reads the endpoint may send the signal immediately.
    """
    stop = asyncio.Event()
    on_stop_signal(stop.set)
    return stop
