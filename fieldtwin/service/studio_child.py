"""Studio as a part of a run: a child process that serves the pages of this instance (`fieldtwin run --studio`)."""

from __future__ import annotations

import asyncio
import contextlib
import signal
import subprocess
from pathlib import Path
from types import TracebackType

from fieldtwin.gateway.core.errors import Unreachable
from fieldtwin.run.processes.children import spawn
from fieldtwin.twin.plant.child import command

READY = "Studio  →  "
"""The text that `fieldtwin studio` prints before its address as soon as it accepts connections."""
STARTS_WITHIN_S = 30.0
ENDS_WITHIN_S = 5.0
LOOK_S = 0.05


class StudioChild:
    """The child process. It runs during ``async with StudioChild(instance, run_dir, listen) as studio``; `url` is the address
    of the page, with its token."""

    def __init__(self, instance: str, run_dir: Path, listen: str) -> None:
        self.url = ""
        self._instance = instance
        self._log = run_dir / "studio.log"
        self._listen = listen
        self._process: subprocess.Popen[bytes] | None = None

    async def __aenter__(self) -> StudioChild:
        arguments = ("studio", "--no-browser", "--instance", self._instance, "--listen", self._listen)
        self._process = spawn(command("fieldtwin", *arguments), self._log)
        self._log.chmod(0o600)  # it contains the token
        try:
            self.url = await self._until_ready(self._process)
        except BaseException:
            await self._end()
            raise
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None
    ) -> None:
        await self._end()

    async def _until_ready(self, process: subprocess.Popen[bytes]) -> str:
        try:
            async with asyncio.timeout(STARTS_WITHIN_S):
                while True:
                    lines = self._log.read_text(encoding="utf-8", errors="replace").splitlines()
                    for line in lines:
                        if line.startswith(READY):
                            return line.removeprefix(READY)
                    if process.poll() is not None:
                        printed = " ".join(line.removeprefix("fieldtwin: ") for line in lines[-3:])
                        raise Unreachable(f"Studio did not start: {printed or 'it printed nothing'}")
                    await asyncio.sleep(LOOK_S)
        except TimeoutError as e:
            raise Unreachable(f"Studio did not start within {STARTS_WITHIN_S:g} s", hint=f"log: {self._log}") from e

    async def _end(self) -> None:
        process = self._process
        if process is None or process.poll() is not None:
            return
        process.send_signal(signal.SIGTERM)
        with contextlib.suppress(subprocess.TimeoutExpired):
            await asyncio.to_thread(process.wait, ENDS_WITHIN_S)
        if process.poll() is None:
            process.kill()
            await asyncio.to_thread(process.wait)
