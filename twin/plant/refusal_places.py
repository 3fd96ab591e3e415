"""Finds the program line that set each refused output, by asking the PLC's process once for each journal entry.

The gateway knows tags and values; the PLC's process knows which line of which program assigned them. If the PLC does
not answer, the line stays unknown. The entry is never delayed by more than `ANSWER_S`.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any

from msgspec.structs import asdict

from fieldtwin.gateway.core.control import ControlClient
from fieldtwin.gateway.core.errors import FieldtwinError
from fieldtwin.gateway.runtime.outputs.refusals import Refusals, RefusedOutput

ANSWER_S = 1.0
"""Seconds within which the PLC must answer."""
MOST_WAITING = 64
"""Number of entries that may wait for their line; further ones are reported without it."""


class RefusalPlaces:
    """The lookup that completes the entries of `journal` over the PLC's control channel at `socket`, and then calls `on_entry`
    with each completed entry.
    """

    def __init__(
        self, journal: Refusals, socket: Path, on_entry: Callable[[dict[str, Any]], None] | None = None
    ) -> None:
        self._journal = journal
        self._socket = socket
        self._on_entry = on_entry
        self._waiting: deque[RefusedOutput] = deque()
        self._wake, self._idle = asyncio.Event(), asyncio.Event()
        self._idle.set()
        self._client: ControlClient | None = None
        journal.looks_up = True
        journal.on_new = self._on_new

    def _on_new(self, entry: RefusedOutput) -> None:
        if entry.known or len(self._waiting) >= MOST_WAITING:
            self._complete(entry, "", "")
        else:
            self._waiting.append(entry)
            self._idle.clear()
            self._wake.set()

    def _complete(self, entry: RefusedOutput, program: str, place: str) -> None:
        self._journal.placed(entry.number, program, place)
        if self._on_entry is not None:
            self._on_entry(asdict(entry.status()))

    async def run(self) -> None:
        """Look up the program line of each waiting entry, until cancelled."""
        try:
            while True:
                await self._wake.wait()
                self._wake.clear()
                while self._waiting:
                    entry = self._waiting[0]
                    program, place = await self._origin(entry)
                    self._waiting.popleft()
                    self._complete(entry, program, place)
                self._idle.set()
        finally:
            if self._client is not None:
                await self._client.aclose()

    async def _origin(self, entry: RefusedOutput) -> tuple[str, str]:
        try:
            async with asyncio.timeout(ANSWER_S):
                if self._client is None:
                    self._client = await ControlClient.connect_unix(self._socket)
                answer = await self._client.call("origin", tag=entry.tag, value=entry.first)
        except (FieldtwinError, OSError, TimeoutError):
            client, self._client = self._client, None
            if client is not None:
                await client.aclose()
            return "", ""
        return str(answer.get("program", "")), str(answer.get("place", ""))

    async def settle(self) -> None:
        """Wait until no entry waits for its line, at most `ANSWER_S`."""
        try:
            async with asyncio.timeout(ANSWER_S):
                await self._idle.wait()
        except TimeoutError:
            pass  # the entries are reported without their lines
