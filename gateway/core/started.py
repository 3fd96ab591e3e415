"""What is started whole or not at all, and ended in the reverse order of its beginning. It must never know what that is."""

from __future__ import annotations

from abc import ABC, abstractmethod
from contextlib import AsyncExitStack
from typing import Self


class Started(ABC):
    """``async with``: `_start` puts what it begins on `_stack`; where it fails, what was begun is ended, and the error goes on.

    In the end `_stop` goes first, while all of it is there, and the stack is unwound whatever came of that.
    """

    def __init__(self) -> None:
        self._stack = AsyncExitStack()

    @abstractmethod
    async def _start(self) -> None:
        """Begin, in order."""

    async def _stop(self) -> None:  # noqa: B027  # most have nothing to do then
        """What is to be done before anything is ended: nothing, unless said."""

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
