"""Choose the event loop of a server program: uvloop if it is installed (the `perf` extra), else asyncio's own loop.

uvloop is the fastest on sockets, but its timers have whole milliseconds, which is too coarse for a serial line. A serial
line therefore gets asyncio's loop with exact timers.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine
from contextlib import suppress
from importlib import import_module
from typing import Any, TypeVar

from fieldtwin.gateway.wallclock import precise_loop

T = TypeVar("T")


def run(main: Coroutine[Any, Any, T], *, serial: bool = False) -> T:
    """Run `main` as `asyncio.run` does. `serial` states whether `main` needs the exact timers of a serial line."""
    factory: Callable[[], asyncio.AbstractEventLoop] = precise_loop
    if not serial:
        with suppress(ImportError):
            factory = import_module("uvloop").new_event_loop
    with asyncio.Runner(loop_factory=factory) as runner:
        return runner.run(main)
