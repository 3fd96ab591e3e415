"""Wait for the end of a program in this terminal: a signal, or a failure of one of its tasks."""

from __future__ import annotations

import asyncio

from fieldtwin.gateway.core.concurrency.nursery import Nursery


async def until_stopped(nursery: Nursery, stop: asyncio.Event) -> None:
    """Return when `stop` is set.

    Raises the error of a failed child of `nursery` at once, so that no server stops silently.
    """
    stopping = nursery.start(stop.wait(), "until stopped")
    failing = asyncio.ensure_future(nursery.wait())
    try:
        await asyncio.wait([stopping, failing], return_when=asyncio.FIRST_COMPLETED)
        if failing.done():
            failing.result()
    finally:
        failing.cancel()
        await asyncio.gather(failing, return_exceptions=True)
