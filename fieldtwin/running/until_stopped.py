"""Wait for the end of a program in this terminal: a signal, or a failure of one of its tasks."""

from __future__ import annotations

import asyncio
import signal

from fieldtwin.gateway.core.nursery import Nursery


async def until_stopped(nursery: Nursery) -> None:
    """Return at SIGINT or SIGTERM.

    Raises the error of a failed child of `nursery` at once, so that no server stops silently.
    """
    stop = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, stop.set)
    stopping = nursery.start(stop.wait(), "until stopped")
    failing = asyncio.ensure_future(nursery.wait())
    try:
        await asyncio.wait([stopping, failing], return_when=asyncio.FIRST_COMPLETED)
        if failing.done():
            failing.result()
    finally:
        failing.cancel()
        await asyncio.gather(failing, return_exceptions=True)
