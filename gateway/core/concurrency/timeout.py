"""Wait for an event with a time limit: the future that is awaited, and the timer that ends the wait.

An event loop for simulated time may offer `timer(delay_s)`, which returns a future that is done after the delay, or earlier if
the caller sets its result. This takes half as many steps of the event loop as the future and the timer that are used on all other
loops.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable


def start_timeout(
    loop: asyncio.AbstractEventLoop, delay_s: float
) -> tuple[asyncio.Future[None], Callable[[], None] | None]:
    """Return a future that is done after `delay_s` seconds, or earlier if the caller sets its result.

    The second value is a function to call after the future was awaited, or None if there is nothing to call.
    """
    made = getattr(loop, "timer", None)
    if made is not None:
        return made(delay_s), None
    waiter = loop.create_future()
    return waiter, loop.call_later(delay_s, ring, waiter).cancel


def ring(waiter: asyncio.Future[None]) -> None:
    """End the wait for `waiter` by setting its result, unless the wait has already ended."""
    if not waiter.done():
        waiter.set_result(None)
