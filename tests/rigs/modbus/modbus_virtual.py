"""The Modbus client in virtual time: an event loop whose time jumps to the next timer, and a wire in memory.

Seconds pass at once, and every time is exact. Waiting for anything except a timer or memory is a deadlock, and raises.
"""

from __future__ import annotations

import asyncio
import math
import selectors
from collections.abc import Callable, Coroutine
from typing import Any, TypeVar

from fieldtwin.gateway.core.connection import ByteConnection, RS232Connection, TCPConnection, closed_locally
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import ConnectionLost

T = TypeVar("T")


class _Jump(selectors.SelectSelector):
    """Instead of waiting, advance the time. Whole nanoseconds, so that the loop and the clock never disagree."""

    now_ns = 0

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        if timeout is None:
            raise AssertionError("deadlock: nothing will ever happen any more")
        self.now_ns += math.ceil(timeout * 1e9)
        return []


class VirtualLoop(asyncio.SelectorEventLoop):
    """The loop starts at 0 and is its own `Clock`."""

    def __init__(self) -> None:
        self._jump = _Jump()
        super().__init__(self._jump)

    def time(self) -> float:
        return self._jump.now_ns / 1e9

    def monotonic_ns(self) -> int:
        return self._jump.now_ns

    def utc_ns(self) -> int:
        return self._jump.now_ns

    async def sleep_until_ns(self, deadline_ns: int) -> None:
        while self._jump.now_ns < deadline_ns:
            await asyncio.sleep((deadline_ns - self._jump.now_ns) / 1e9)


def run_virtually(coro: Coroutine[Any, Any, T]) -> T:
    """Run `coro` on a fresh `VirtualLoop`; fail if it leaves tasks."""
    with asyncio.Runner(loop_factory=VirtualLoop) as runner:
        result = runner.run(coro)
        leaked = asyncio.all_tasks(runner.get_loop())
        assert not leaked, f"leaked tasks: {leaked}"
        return result


class VirtualWire(ByteConnection):
    """The near end of a wire with a scripted remote end: `on_write` gets the written data, and `feed`s the replies."""

    def __init__(
        self,
        endpoint: Endpoint,
        on_write: Callable[[bytes], None],
        kind: type[RS232Connection | TCPConnection] = RS232Connection,
    ) -> None:
        super().__init__(kind(), endpoint)
        self._on_write = on_write

    async def write(self, data: bytes) -> None:
        if self.lost is not None:
            raise ConnectionLost("the wire is cut", where=str(self.endpoint))
        self._on_write(data)

    async def aclose(self) -> None:
        self.feed_lost(closed_locally(self.endpoint))
