"""`fieldtwin link` as a child process: a virtual serial port on this host whose line is carried over TCP."""

from __future__ import annotations

import asyncio
import subprocess
from pathlib import Path

from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import ReplyTimeout, Unreachable
from fieldtwin.run.processes.children import START_TIMEOUT_S, spawn
from fieldtwin.twin.plant.child import command

LINGER_S = 2.0
"""Time in seconds for which the serial line stays open after the run's own process was killed, so that the gateway can write
its safe values over it.
"""


class LinkChild:
    """A child process that creates the port `link` and carries its bytes to `target`. `ready` waits until the port exists."""

    def __init__(self, link: Path, target: Endpoint, log: Path) -> None:
        self._link = link
        self._log = log
        link.unlink(missing_ok=True)
        self._process = spawn(command("fieldtwin", "link", str(link), str(target), linger_s=LINGER_S), log)

    async def ready(self, timeout_s: float = START_TIMEOUT_S) -> None:
        deadline = asyncio.get_running_loop().time() + timeout_s
        while not self._link.exists():
            if self._process.poll() is not None:
                text = self._log.read_text(encoding="utf-8", errors="replace").strip()
                raise Unreachable(f"the link ended: {text.splitlines()[-1] if text else 'no reason given'}")
            if asyncio.get_running_loop().time() > deadline:
                raise ReplyTimeout("the link created no port", where=str(self._link))
            await asyncio.sleep(0.02)

    async def end(self) -> None:
        self._process.terminate()
        try:
            await asyncio.to_thread(self._process.wait, 2.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            await asyncio.to_thread(self._process.wait)
