"""Run a fieldtwin command as a child process of Studio, in its own process group, so that its children end with it."""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
from asyncio.subprocess import DEVNULL, PIPE, Process
from typing import Any

from fieldtwin.twin.plant.child import command

STOPS_WITHIN_S = 10.0
"""How long an interrupted command may take to end before it is killed."""


class OutputTooLong(Exception):
    """Raised when a command prints more than its reader accepts."""


async def start(*arguments: str, **options: Any) -> Process:
    """Start ``fieldtwin ARGUMENTS`` without input and with both outputs in pipes. `options` are those of a subprocess."""
    settings: dict[str, Any] = {"stdin": DEVNULL, "stdout": PIPE, "stderr": PIPE, "start_new_session": True}
    return await asyncio.create_subprocess_exec(*command("fieldtwin", *arguments), **settings | options)


async def read_whole(stream: asyncio.StreamReader, most_bytes: int) -> bytes:
    """Read an output up to its end, and return it. Raises `OutputTooLong` for more than `most_bytes`."""
    output = bytearray()
    while chunk := await stream.read(65_536):
        output += chunk
        if len(output) > most_bytes:
            raise OutputTooLong
    return bytes(output)


async def interrupt(process: Process, following: asyncio.Future[None]) -> None:
    """Interrupt a command as Ctrl-C does, and kill it if `following`, which reads its output, does not end within
    `STOPS_WITHIN_S`."""
    with contextlib.suppress(ProcessLookupError):
        process.send_signal(signal.SIGINT)
    await asyncio.wait([following], timeout=STOPS_WITHIN_S)
    kill(process)


def kill(process: Process) -> None:
    """Kill the remaining processes of the group, if there are any."""
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.killpg(process.pid, signal.SIGKILL)
