"""The program under test. It is started with the endpoint in its environment, its output is read, and it is ended after the
test.
"""

from __future__ import annotations

import asyncio
import os
import signal
from collections import deque
from collections.abc import Callable, Sequence
from types import TracebackType

from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import UsageError

END_WITHIN_S = 3.0
LAST_LINES = 12
READ_SIZE = 65_536
OnText = Callable[[str, bool], None]


def environment(endpoint: Endpoint) -> dict[str, str]:
    """Return the environment variables that tell the program its endpoint. `endpoint` is the client's side of it."""
    env = {"FIELDTWIN_ENDPOINT": str(endpoint)}
    if endpoint.is_serial:
        env["FIELDTWIN_TTY"] = endpoint.path
    elif endpoint.is_can:
        env["FIELDTWIN_CHANNEL"] = endpoint.path
        env["FIELDTWIN_INTERFACE"] = endpoint.interface
    if not endpoint.is_serial and (not endpoint.is_can or endpoint.interface == "fieldtwin"):
        host, port = endpoint.address
        env |= {"FIELDTWIN_HOST": host, "FIELDTWIN_PORT": str(port)}
    return env


def _flush(tty: str) -> None:
    """Discard unread bytes: a pseudo-terminal keeps them, unlike a closed serial port."""
    try:
        descriptor = os.open(tty, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    except OSError:
        return  # the other end of a real line
    import termios  # imported late: only on systems with pseudo-terminals

    try:
        termios.tcflush(descriptor, termios.TCIOFLUSH)
    finally:
        os.close(descriptor)


class ProgramUnderTest:
    """The program under test: ``async with Program(argv, endpoint, on_text, on_end)``.

    It and its children end on leaving. `on_text` receives its output, and whether that is its log (standard error);
    `on_end` its exit code when it ends by itself. `said` are the last lines of its output and of its log.
    """

    def __init__(
        self,
        argv: Sequence[str],
        endpoint: Endpoint,
        on_text: OnText,
        on_end: Callable[[int], None],
    ) -> None:
        self.said: deque[str] = deque(maxlen=LAST_LINES)
        self._argv = argv
        self._endpoint = endpoint
        self._env = {**os.environ, "PYTHONUNBUFFERED": "1", **environment(endpoint)}
        self._on_text, self._on_end = on_text, on_end
        self._process: asyncio.subprocess.Process | None = None
        self._task: asyncio.Task[None] | None = None

    async def __aenter__(self) -> ProgramUnderTest:
        await self._start()
        return self

    async def restart(self) -> None:
        """End the program, if it still runs, and start it again."""
        await self._end()
        if self._endpoint.is_serial:
            _flush(self._endpoint.path)
        await self._start()

    async def _start(self) -> None:
        try:
            self._process = await asyncio.create_subprocess_exec(
                *self._argv,
                stdin=asyncio.subprocess.DEVNULL,
                stdout=asyncio.subprocess.PIPE,
                stderr=asyncio.subprocess.PIPE,
                env=self._env,
                start_new_session=True,
            )
        except OSError as e:
            raise UsageError(f"cannot start {self._argv[0]!r}: {e.strerror or e}") from e
        self._task = asyncio.create_task(self._listen(), name="program under test")

    async def _listen(self) -> None:
        assert self._process is not None
        assert self._process.stdout is not None
        assert self._process.stderr is not None
        await asyncio.gather(self._hear(self._process.stdout, False), self._hear(self._process.stderr, True))
        self._on_end(await self._process.wait())

    async def _hear(self, stream: asyncio.StreamReader, log: bool) -> None:
        rest = ""
        while chunk := await stream.read(READ_SIZE):
            text = chunk.decode(errors="replace")
            self._on_text(text, log)
            *lines, rest = (rest + text).split("\n")
            rest = rest[-READ_SIZE:]
            self.said.extend(line[:200] for line in lines if line.strip())

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None
    ) -> None:
        await self._end()

    async def _end(self) -> None:
        assert self._process is not None
        assert self._task is not None
        self._task.cancel()
        await asyncio.gather(self._task, return_exceptions=True)
        for number in (signal.SIGTERM, signal.SIGKILL):
            try:
                os.killpg(self._process.pid, number)
            except ProcessLookupError:
                pass
            try:
                async with asyncio.timeout(END_WITHIN_S):
                    await self._process.wait()
                break
            except TimeoutError:
                continue
        transport = getattr(self._process, "_transport", None)
        if transport is not None:
            transport.close()  # otherwise the garbage collector would close the pipe, with a warning
