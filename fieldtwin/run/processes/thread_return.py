"""Restart the process of a run's digital thread whenever it dies.

The digital thread only observes, and no control function depends on it, so a plant continues without it; events during the gap
are in no log, so the gap is kept short. This module does not depend on the data or the destination of the digital thread.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable

from fieldtwin.gateway.core.control import ControlClient
from fieldtwin.gateway.core.errors import FieldtwinError
from fieldtwin.gateway.runtime.buses.backoff import Backoff
from fieldtwin.run.processes.children import Child

FIRST_S, LIMIT_S = 0.5, 60.0
LASTED_S = 60.0
"""If a child ran for longer than this (seconds), the growing delay before a restart begins again at its first value."""
LOOK_S = 0.1


class ThreadReturn:
    """A watcher that restarts `child`, the process of the digital thread.

    `start` creates a new child, `came` is called with its control channel, and `failed` with the reason why a child did not
    start. `deaths` counts the children that died. After `run` has ended, `end` ends the current child.
    """

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
        """Restart the child whenever it dies, until cancelled."""
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
        """Start a new child, and wait until it ends."""
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
        """End the current child process: SIGTERM first, SIGKILL after a time limit."""
        await self._child.end()
