"""Waiting for something, and no longer than so long: the future that is awaited, and the timer that ends it.

An event loop for simulated time may offer `alarm(delay_s)`: a future that is done then, or before by whoever sets it. That takes
half the steps of a future and a timer; on any other loop it is those two.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable


def alarm(loop: asyncio.AbstractEventLoop, delay_s: float) -> tuple[asyncio.Future[None], Callable[[], None] | None]:
    """A future that is done after `delay_s` seconds, or before by whoever sets its result; and what to call once it was awaited,
    if anything."""
    made = getattr(loop, "alarm", None)
    if made is not None:
        return made(delay_s), None
    waiter = loop.create_future()
    return waiter, loop.call_later(delay_s, ring, waiter).cancel


def ring(waiter: asyncio.Future[None]) -> None:
    """End the wait, unless it has ended."""
    if not waiter.done():
        waiter.set_result(None)
