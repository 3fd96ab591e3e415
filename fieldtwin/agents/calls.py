"""Calls of tools: checked arguments, a time limit, a bounded result, and an entry in the audit log before and after each."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass

import msgspec

from fieldtwin.agents.library import Library
from fieldtwin.agents.results import MOST_CHARACTERS
from fieldtwin.agents.tool import Tool
from fieldtwin.agents.workplace import Workplace
from fieldtwin.gateway.core.errors import Bug, FieldtwinError, ReplyTimeout, UsageError
from fieldtwin.gateway.runtime.audit_log import AuditLog

MOST_AUDITED = 2_000
"""Number of characters of a call's arguments that the audit log keeps."""
MOST_AT_A_TIME = 8
"""Number of calls that run at the same time; further calls wait."""


@dataclass(frozen=True)
class Answer:
    """The answer to a call. `failed`: the text is that of an error."""

    text: str
    failed: bool = False


class Calls:
    """The tools and resources of one agent. `by` is its name in the audit log."""

    def __init__(self, tools: Sequence[Tool], library: Library, workplace: Workplace, audit: AuditLog, by: str) -> None:
        self.tools = {tool.name: tool for tool in tools}
        self.library = library
        self._workplace = workplace
        self._audit = audit
        self._by = by
        self._running = asyncio.Semaphore(MOST_AT_A_TIME)

    async def call(self, name: str, arguments: object) -> Answer:
        """Carry out a call of a tool. All errors are answers."""
        return await self._recorded(name, arguments, lambda: self._carried_out(name, arguments))

    async def read(self, uri: str) -> Answer:
        """Read a resource. All errors are answers."""
        return await self._recorded("read a resource", uri, lambda: self.library.read(uri))

    async def _recorded(self, name: str, arguments: object, work: Callable[[], Awaitable[object]]) -> Answer:
        """Do `work` with an entry in the audit log before and after it. Without the first entry it is not done."""
        try:
            self._audit.note("call", "", by=self._by, result="asked", tool=name[:80], arguments=_audited(arguments))
        except FieldtwinError as e:
            return Answer(f"the call is refused, because it cannot be recorded: {e}", failed=True)
        try:
            async with self._running:
                answer = Answer(self._workplace.results.shown(await work()))
        except FieldtwinError as e:
            answer = Answer(f"{type(e).__name__}: {e}"[:MOST_CHARACTERS], failed=True)
        except asyncio.CancelledError:
            self._audit.note("call", "", by=self._by, result="cancelled", tool=name[:80])
            raise
        result = f"failed: {answer.text[:MOST_AUDITED]}" if answer.failed else "done"
        try:
            self._audit.note("call", "", by=self._by, result=result, tool=name[:80])
        except FieldtwinError as e:
            return Answer(f"the call was carried out, and its end cannot be recorded: {e}", failed=True)
        return answer

    async def _carried_out(self, name: str, arguments: object) -> object:
        tool = self.tools.get(name)
        if tool is None:
            raise UsageError(f"no tool {name[:80]!r}", expected=", ".join(self.tools))
        checked = tool.arguments(arguments)
        try:
            async with asyncio.timeout(tool.within_s):
                return await tool.handler(self._workplace, checked)
        except TimeoutError as e:
            raise ReplyTimeout(f"{name} did not end within {tool.within_s:g} s, and was stopped") from e
        except FieldtwinError:
            raise
        except Exception as e:  # a bug in one tool must not end the server, and the agent sees no traceback
            raise Bug(f"{name}: {type(e).__name__}: {e}") from e


def _audited(arguments: object) -> str:
    try:
        text = msgspec.json.encode(arguments).decode()
    except (TypeError, ValueError, OverflowError, RecursionError):
        text = repr(arguments)
    return text[:MOST_AUDITED]
