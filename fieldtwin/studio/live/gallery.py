"""The instances that a server observes: each is attached when a client first asks for it, and kept until the server ends."""

from __future__ import annotations

import asyncio
from contextlib import AsyncExitStack

from fieldtwin.gateway.core.clock import Clock
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.studio.live.attachment import Attachment
from fieldtwin.studio.live.instances import FoundInstance, find_instance, find_instances

MOST_ATTACHED = 8


class NoInstance(UsageError):
    """Raised when the instance does not exist on this computer."""


class Gallery:
    """The attached instances by name. Use it as ``async with Gallery(clock) as gallery``. With `only` it knows one instance."""

    def __init__(self, clock: Clock, only: str = "") -> None:
        self._clock = clock
        self._only = only
        self._attached: dict[str, tuple[Attachment, AsyncExitStack]] = {}
        self._lock = asyncio.Lock()

    async def __aenter__(self) -> Gallery:
        return self

    async def __aexit__(self, *error: object) -> None:
        for name in list(self._attached):
            await self._detach(name)

    async def found(self) -> list[FoundInstance]:
        """Return the instances on this computer that the gallery may show, running ones first."""
        return [found for found in await find_instances() if self._only in ("", found.name)]

    async def attached(self, name: str) -> Attachment:
        """Return the attachment of an instance.

        If a run was started again under the same name, a new attachment is made. Raises `NoInstance`, and `FileInvalid` for a
        run of another version.
        """
        async with self._lock:
            found = await find_instance(name) if self._only in ("", name) else None
            if found is None:
                others = ", ".join(other.name for other in await self.found())
                raise NoInstance(
                    f"no instance {name!r} on this computer", expected=others or "an instance, but none exists"
                )
            known = self._attached.get(name)
            if known is not None and (found.record is None or found.record == known[0].record):
                return known[0]
            if known is not None:
                await self._detach(name)
            while len(self._attached) >= MOST_ATTACHED:
                await self._detach(next(iter(self._attached)))
            stack = AsyncExitStack()
            attachment = await stack.enter_async_context(Attachment(found, self._clock))
            self._attached[name] = attachment, stack
            return attachment

    async def _detach(self, name: str) -> None:
        _, stack = self._attached.pop(name)
        await stack.aclose()
