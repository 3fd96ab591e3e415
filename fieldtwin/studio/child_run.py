"""A command of fieldtwin that runs as a child process and prints its result as JSON, such as a scenario or a forecast."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence
from typing import Any

import msgspec

from fieldtwin.studio import child_process

MOST_OUTPUT_BYTES = 8 << 20
MOST_MESSAGE_BYTES = 16_384
LONGEST_S = 1800.0


class ChildRun:
    """A run of a command, started with ``await ChildRun.started(arguments, parse)``. It ends by itself, after `LONGEST_S`, or
    with `stop`.

    `parse` returns the result from the standard output, or raises `msgspec.MsgspecError` or `ValueError`; the messages of the
    process are then the reason (`trouble`).
    """

    def __init__(self, process: asyncio.subprocess.Process, parse: Callable[[bytes], Any]) -> None:
        self.trouble = ""
        """The reason for a missing result; empty while the process runs."""
        self.result: Any = None
        self._process = process
        self._parse = parse
        self._began_s = asyncio.get_running_loop().time()
        self._took_s = 0.0
        self._following = asyncio.ensure_future(self._follow())

    @classmethod
    async def started(cls, arguments: Sequence[str], parse: Callable[[bytes], Any]) -> ChildRun:
        """Start ``fieldtwin ARGUMENTS``."""
        return cls(await child_process.start(*arguments), parse)

    @property
    def is_running(self) -> bool:
        """Return whether the process runs."""
        return not self._following.done()

    @property
    def elapsed_s(self) -> float:
        """Return for how long it has been running, or how long it took."""
        return asyncio.get_running_loop().time() - self._began_s if self.is_running else self._took_s

    async def _follow(self) -> None:
        assert self._process.stdout is not None
        assert self._process.stderr is not None
        messages = asyncio.ensure_future(_tail(self._process.stderr))
        try:
            async with asyncio.timeout(LONGEST_S):
                output = await child_process.read_whole(self._process.stdout, MOST_OUTPUT_BYTES)
                await self._process.wait()
        except TimeoutError:
            self.trouble = self.trouble or f"stopped after {LONGEST_S:g} s"
        except child_process.OutputTooLong:
            self.trouble = f"stopped: the result is longer than {MOST_OUTPUT_BYTES} bytes"
        else:
            self._take(output, await messages)
        finally:
            self._took_s = asyncio.get_running_loop().time() - self._began_s
            child_process.kill(self._process)
            await self._process.wait()
            messages.cancel()

    def _take(self, output: bytes, messages: bytes) -> None:
        try:
            self.result = self._parse(output)
        except (msgspec.MsgspecError, ValueError):
            said = messages.decode(errors="replace").strip()[-800:]
            self.trouble = self.trouble or said or "the run ended without a result"

    async def stop(self) -> None:
        """Interrupt the run, and kill it with its processes if it does not end."""
        if self.is_running:
            self.trouble = "stopped"
            await child_process.interrupt(self._process, self._following)
        await asyncio.gather(self._following, return_exceptions=True)


async def _tail(stream: asyncio.StreamReader) -> bytes:
    tail = b""
    while chunk := await stream.read(4096):
        tail = (tail + chunk)[-MOST_MESSAGE_BYTES:]
    return tail
