"""Tasks that belong together, started and stopped in order.

``asyncio.TaskGroup`` cancels in the order of a set, which differs from run to run; under virtual time that changes the
trace. Here children are kept in a list, stopped in the order of their creation, and the first failure stops all.
"""

from __future__ import annotations

import asyncio
from collections.abc import Coroutine
from types import TracebackType
from typing import Any


class Nursery:
    """A group of tasks: ``async with Nursery() as nursery: nursery.start(coro, "name")``.

    On leaving, every child is cancelled and awaited. `wait` returns when all children have ended, and raises the first failure.
    """

    def __init__(self) -> None:
        self._children: list[asyncio.Task[Any]] = []
        self._ended = asyncio.Event()

    def start(self, coro: Coroutine[Any, Any, Any], name: str) -> asyncio.Task[Any]:
        """Run `coro` as a child named `name`."""
        task = asyncio.get_running_loop().create_task(coro, name=name)
        task.add_done_callback(self._on_done)
        self._children.append(task)
        return task

    def _on_done(self, task: asyncio.Task[Any]) -> None:
        self._ended.set()

    async def wait(self) -> None:
        """Wait until a child fails or all have ended. Raises the first failure in order of creation."""
        while any(not child.done() for child in self._children):
            await self._ended.wait()
            self._ended.clear()
            self._raise_first()
        self._raise_first()

    def failure(self) -> BaseException | None:
        """Return the exception of the first child that failed, in order of creation; None while no child has failed."""
        for child in self._children:
            if child.done() and not child.cancelled() and (error := child.exception()) is not None:
                return error
        return None

    def _raise_first(self) -> None:
        error = self.failure()
        if error is not None:
            raise error

    async def __aenter__(self) -> Nursery:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None
    ) -> None:
        me = asyncio.current_task()
        asked_before = me.cancelling() if me is not None else 0
        failed: BaseException | None = None
        for child in self._children:
            child.cancel()
            while not child.done():
                try:
                    await asyncio.wait([child])
                except asyncio.CancelledError:
                    child.cancel()  # this task was cancelled meanwhile: cancel the child, and raise below
            if not child.cancelled():  # kept, and raised below unless another exception is already being raised
                failed = failed or child.exception()
        if me is not None and me.cancelling() > asked_before:
            raise asyncio.CancelledError
        if failed is not None and error is None:
            raise failed
