"""The thread's process of a run, kept: started again when it dies. It watches; nothing that controls anything depends on it, so a
plant goes on without, and what nobody watched is in no log. The shorter that is, the better.

It must never know what a thread is, nor where it goes.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable

from fieldtwin.gateway.core.control import ControlClient
from fieldtwin.gateway.core.errors import FieldtwinError
from fieldtwin.gateway.runtime.backoff import Backoff
from fieldtwin.running.children import Child

FIRST_S, LIMIT_S = 0.5, 60.0
LASTED_S = 60.0
"""Who lasted so long had no reason to die at once again."""
LOOK_S = 0.1


class ThreadReturn:
    """Watches over `child`. `start` makes another one, `came` is given its control channel; `failed` is told why one did not come
    up. `deaths` counts. `end` ends the child that there is, when this does not run any more."""

    def __init__(
        self,
        child: Child,
        start: Callable[[], Child],
        came: Callable[[ControlClient], None],
        failed: Callable[[FieldtwinError], None],
    ) -> None:
        self.deaths = 0
        self._child = child
        self._start = start
        self._came = came
        self._failed = failed

    async def run(self) -> None:
        """Until cancelled."""
        now = asyncio.get_running_loop().time
        backoff, began_s = Backoff(FIRST_S, LIMIT_S), now()
        while True:
            while self._child.returncode is None:
                await asyncio.sleep(LOOK_S)
            self.deaths += 1
            if now() - began_s > LASTED_S:
                backoff.reset()
            await asyncio.sleep(backoff.next_s())
            began_s = now()
            await self._another()

    async def _another(self) -> None:
        """One that works until it ends by itself, if it comes up at all."""
        self._child = self._start()
        client: ControlClient | None = None
        try:
            client = await self._child.connect()
            self._came(client)
            while self._child.returncode is None:
                await asyncio.sleep(LOOK_S)
        except FieldtwinError as e:
            self._failed(e)
            await self._child.end()
        finally:
            if client is not None:
                await client.aclose()

    async def end(self) -> None:
        """In order, as any child."""
        await self._child.end()
