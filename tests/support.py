"""Helpers shared by tests: run a coroutine on a separate loop that must end clean, and wait for a condition."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Coroutine
from typing import Any, TypeVar

T = TypeVar("T")


def run(coro: Coroutine[Any, Any, T], timeout_s: float = 20.0) -> T:
    """Run `coro` on a fresh loop; fail if it takes too long or leaves tasks."""

    async def guarded() -> T:
        before = asyncio.all_tasks()
        async with asyncio.timeout(timeout_s):
            result = await coro
        await asyncio.sleep(0)  # let callbacks of the last close run
        leaked = [t for t in asyncio.all_tasks() - before if not t.done()]
        assert not leaked, f"leaked tasks: {leaked}"
        return result

    return asyncio.run(guarded())


async def eventually(condition: Callable[[], bool | Awaitable[bool]], within_s: float = 5.0, what: str = "") -> None:
    """Wait until `condition()` holds; fail after `within_s` seconds."""
    loop = asyncio.get_running_loop()
    deadline = loop.time() + within_s
    while True:
        result = condition()
        if result if isinstance(result, bool) else await result:
            return
        assert loop.time() < deadline, f"not within {within_s} s: {what or condition}"
        await asyncio.sleep(0.005)
