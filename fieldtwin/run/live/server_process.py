"""A server of tags that runs in a separate process, such as an OPC UA server, started again whenever it dies.

No control function depends on it. The gateway reports a server whose process is missing (`fieldtwin.twin.plant.server_reports`).
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable

from fieldtwin.gateway.core.errors import FieldtwinError
from fieldtwin.gateway.runtime.buses.backoff import Backoff
from fieldtwin.run.processes.children import Child

FIRST_S, LIMIT_S = 0.5, 60.0
LASTED_S = 60.0
"""If a process ran for longer than this (seconds), the growing delay before a restart begins again at its first value."""
LOOK_S = 0.1


class ServerProcess:
    """A watcher that restarts a process. `start` creates it, and `failed` is called with the reason of each death.

    `run` runs until cancelled; after that, `end` ends the present process.
    """

    def __init__(self, start: Callable[[], Child], failed: Callable[[FieldtwinError], None]) -> None:
        self._start = start
        self._failed = failed
        self._child: Child | None = None

    async def run(self) -> None:
        """Start the process, and restart it whenever it dies, until cancelled."""
        now = asyncio.get_running_loop().time
        backoff = Backoff(FIRST_S, LIMIT_S)
        while True:
            began_s = now()
            self._child = child = self._start()
            while (failure := child.failure()) is None:
                await asyncio.sleep(LOOK_S)
            self._failed(failure)
            if now() - began_s > LASTED_S:
                backoff.reset()
            await asyncio.sleep(backoff.next_s())

    async def end(self) -> None:
        """End the present process: SIGTERM first, SIGKILL after a time limit."""
        if self._child is not None:
            await self._child.end()
