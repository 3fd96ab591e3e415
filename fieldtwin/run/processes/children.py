"""The child processes of a run: each has its own log and control channel and is stopped within a time limit."""

from __future__ import annotations

import asyncio
import subprocess
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path

from fieldtwin.gateway.core.control import ControlClient
from fieldtwin.gateway.core.errors import Bug, FieldtwinError, ReplyTimeout, Unreachable
from fieldtwin.twin.plant.child import command

START_TIMEOUT_S = 30.0
POLL_S = 0.02
ENDS_WITHIN_S = 2.0
"""How long after the loss of its control channel a process may take to end."""

Failure = Callable[[], FieldtwinError | None]
"""A function that returns why a part of a running system has ended, or None while all parts run."""


class ChildFailed(FieldtwinError):
    """Raised when a child process has ended unexpectedly. This process ends with the exit code of the child."""

    def __init__(self, name: str, code: int, said: str, log: Path) -> None:
        self.child_exit_code = code
        text = said or f"ended with {'signal ' + str(-code) if code < 0 else 'exit code ' + str(code)}"
        super().__init__(f"{name}: {text}", hint=f"log: {log}")


@asynccontextmanager
async def naming_failures(failure: Failure | None) -> AsyncIterator[None]:
    """Raise the error that ended a process in place of the loss of its control channel. Do nothing if `failure` is None.

    A process that fails closes its channel a moment before it ends, so the failure may appear up to `ENDS_WITHIN_S` later.
    """
    try:
        yield
    except Unreachable as lost:
        if failure is None:
            raise
        loop = asyncio.get_running_loop()
        until_s = loop.time() + ENDS_WITHIN_S
        while (failed := failure()) is None and loop.time() < until_s:
            await asyncio.sleep(POLL_S)
        if failed is None:
            raise
        raise failed from lost


def spawn(argv: list[str], log: Path) -> subprocess.Popen[bytes]:
    """Start a child process that writes its output to `log`.

    The child gets a separate session, so that Ctrl-C reaches only the calling process, which then ends its children in order.
    """
    with log.open("wb") as out:
        return subprocess.Popen(
            argv, stdin=subprocess.DEVNULL, stdout=out, stderr=subprocess.STDOUT, start_new_session=True
        )


class Child:
    """One child process, in a separate session: Ctrl-C reaches only its parent, which then ends its children in order.

    If the parent is killed, the child ends by itself after `linger_s` seconds.
    """

    def __init__(self, name: str, module: str, config: Path, run_dir: Path, linger_s: float = 0.0) -> None:
        self.name = name
        self.log = run_dir / f"{name}.log"
        self.socket = run_dir / f"{name}.sock"
        self.socket.unlink(missing_ok=True)
        self._process = spawn(command(module, str(config), linger_s=linger_s), self.log)

    @property
    def pid(self) -> int:
        return self._process.pid

    @property
    def returncode(self) -> int | None:
        """Return the exit code of the process after its end, negative for a signal; None while the process runs."""
        return self._process.poll()

    def failure(self) -> ChildFailed | None:
        """Return why the process ended, or None while it runs."""
        code = self.returncode
        if code is None:
            return None
        lines = self.log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
        return ChildFailed(self.name, code, lines[-1] if lines else "", self.log)

    async def connect(self, timeout_s: float = START_TIMEOUT_S) -> ControlClient:
        """Wait until the process reports that it is ready. Raises `ChildFailed` when it ends instead."""
        deadline = asyncio.get_running_loop().time() + timeout_s
        while True:
            failed = self.failure()
            if failed is not None:
                raise failed
            try:
                client = await ControlClient.connect_unix(self.socket)
            except Unreachable:
                if asyncio.get_running_loop().time() > deadline:
                    raise ReplyTimeout(
                        f"the {self.name} process did not become ready", hint=f"log: {self.log}"
                    ) from None
                await asyncio.sleep(POLL_S)
                continue
            try:
                answer = await client.call("ready")
                if not answer.get("ready"):
                    raise Bug(f"the {self.name} process answered, but is not ready", got=str(answer))
            except BaseException:
                await client.aclose()
                raise
            return client

    async def end(self, timeout_s: float = 1.5) -> int | None:
        """Send SIGTERM, then SIGKILL after `timeout_s`; return the exit code."""
        if self.returncode is None:
            self._process.terminate()
        deadline = asyncio.get_running_loop().time() + timeout_s
        while self.returncode is None:
            if asyncio.get_running_loop().time() > deadline:
                self._process.kill()
                await asyncio.to_thread(self._process.wait)
                break
            await asyncio.sleep(POLL_S)
        return self.returncode
