"""Start several parts together or not at all, and end them in reverse order. It must not depend on what the parts are."""

from __future__ import annotations

from abc import ABC, abstractmethod
from contextlib import AsyncExitStack
from typing import Self


class AsyncResource(ABC):
    """An asynchronous context manager that consists of parts. `_start` starts them and puts each on `_stack`.

    If `_start` fails, the parts that were started are ended, and the error is raised. On leaving, `_stop` runs first,
    while all parts still run; then the stack is unwound even if `_stop` failed.
    """

    def __init__(self) -> None:
        self._stack = AsyncExitStack()

    @abstractmethod
    async def _start(self) -> None:
        """Start the parts, in order."""

    async def _stop(self) -> None:  # noqa: B027  # most resources have nothing to do here
        """Carry out work that is needed before the first part is ended. The default does nothing."""

    async def __aenter__(self) -> Self:
        try:
            await self._start()
        except BaseException:
            await self._stack.aclose()
            raise
        return self

    async def __aexit__(self, *exc: object) -> None:
        try:
            await self._stop()
        finally:
            await self._stack.aclose()
