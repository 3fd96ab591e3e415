"""Query a prototype before a digital twin sends a command: one process per query, with a time limit, while the twin continues.

A missing answer is an objection: if the prototype fails, takes too long or cannot be forked, the command is not sent.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import msgspec

from fieldtwin.gateway.core.clock import NS_PER_MS, NS_PER_S, Clock
from fieldtwin.gateway.core.errors import Bug, FieldtwinError, Unreachable, UsageError
from fieldtwin.gateway.core.statemachine import decode_period
from fieldtwin.gateway.core.values import COMMAND
from fieldtwin.gateway.store.event import KnowledgeStore
from fieldtwin.run.what_if.last_known import LastKnown
from fieldtwin.run.what_if.state import Number
from fieldtwin.twin.model.mape.what_if import Question
from fieldtwin.twin.plant.child import command as child_command
from fieldtwin.twin.site.system import System

TIMEOUT_S = 60.0
VALUES_WITHIN_S = 12.0
"""Time in seconds within which a new twin has received every value: a plant repeats unchanged values every ten seconds."""
LOOK_MS = 100
MOST_KEPT = 1 << 16
"""Largest number of bytes of the process's output that are kept."""


class QuestionMessage(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A what-if question as it is sent to the process `fieldtwin.run.what_if.asked`.

    `require`, `finally_`, `horizon_s` and `settle_s` are as in `fieldtwin.twin.model.mape.what_if.Question`.
    """

    system: str
    horizon_s: float
    require: tuple[str, ...]
    finally_: tuple[str, ...]
    settle_s: float
    profiles: tuple[str, ...] = ()
    prototype_file: str = ""
    period_s: int = 0
    values: dict[str, Number] = {}
    programs: dict[str, dict[str, Number]] = {}
    only_check: bool = False


@dataclass(frozen=True)
class ForkSubject:
    """The system to fork: the twin's system, its profiles, and its prototype file."""

    system: System
    profiles: tuple[Path, ...] = ()
    prototype_file: Path | None = None


class Asking:
    """The `WhatIf` of a twin, which runs each query in a separate process. The twin runs `run` as one of its tasks, and passes
    each received event to `known`.
    """

    def __init__(
        self,
        subject: ForkSubject,
        clock: Clock,
        timeout_s: float = TIMEOUT_S,
        on_ask: Callable[[COMMAND, Question], None] = lambda command, question: None,
    ) -> None:
        self.known = LastKnown(subject.system)
        self._subject = subject
        self._clock = clock
        self._timeout_s = timeout_s
        self._on_ask = on_ask
        self._began_ns: int | None = None
        self._asked: tuple[COMMAND, Question] | None = None
        self._answer: str | None = None
        self._wake = asyncio.Event()

    def ask(self, command: COMMAND, question: Question) -> None:
        if self._asked is not None:
            raise Bug("a simulation was requested while another one runs")
        self._asked, self._answer = (command, question), None
        self._wake.set()

    def answer(self) -> str | None:
        return self._answer

    async def recall(self, store: KnowledgeStore, origins: Sequence[str]) -> None:
        """Restore what the twin knew before it was restarted."""
        from fieldtwin.run.what_if.known import recall

        for origin in origins:
            await recall(store, origin, self.known.take)

    async def check(self, questions: Sequence[Question]) -> None:
        """Check that the prototype can be made and that the requirements can be evaluated. Raises `UsageError`."""
        for question in questions:
            found = await self._process(self._form(question, only_check=True))
            if found:
                raise UsageError(f"a prototype of {self._subject.system.name} cannot be asked: {found}")

    async def run(self) -> None:
        """Answer questions until cancelled."""
        self._began_ns = self._clock.monotonic_ns()
        while True:
            await self._wake.wait()
            self._wake.clear()
            if self._asked is not None:
                command, question = self._asked
                self._on_ask(command, question)
                self._answer = await self._find_out(command, question)
                self._asked = None

    async def _find_out(self, command: COMMAND, question: Question) -> str:
        assert self._began_ns is not None
        enough_ns = self._began_ns + round(VALUES_WITHIN_S * NS_PER_S)
        while self.known.unknown and self._clock.monotonic_ns() < enough_ns:
            await self._clock.sleep_until_ns(self._clock.monotonic_ns() + LOOK_MS * NS_PER_MS)
        if not self.known.utc_ms:
            return "a simulation is required, but the present state of the plant is not known"
        try:
            found = await self._process(self._form(question, command))
        except FieldtwinError as e:
            found = str(e)
        return f"simulated: {found}" if found else ""

    def _form(self, question: Question, command: COMMAND | None = None, *, only_check: bool = False) -> QuestionMessage:
        state = self.known.state("")
        return QuestionMessage(
            str(self._subject.system.path),
            question.horizon_s,
            question.require,
            question.finally_,
            question.settle_s,
            tuple(str(p) for p in self._subject.profiles),
            str(self._subject.prototype_file or ""),
            decode_period(command) if command is not None else 0,
            dict(state.values),
            {name: dict(variables) for name, variables in state.programs.items()},
            only_check,
        )

    async def _process(self, asked: QuestionMessage) -> str:
        """Return the objection of a separate process. Raises `Unreachable` if it took too long or died."""
        try:
            process = await asyncio.create_subprocess_exec(
                *child_command("fieldtwin.run.what_if.asked"),
                stdin=asyncio.subprocess.PIPE, stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.PIPE,
            )  # fmt: skip
        except OSError as e:
            raise Unreachable(f"no process can be started: {e.strerror or e}") from e
        try:
            async with asyncio.timeout(self._timeout_s):
                out, err = await _talk_with(process, msgspec.json.encode(asked))
        except TimeoutError as e:
            raise Unreachable(f"no answer within {self._timeout_s:g} s") from e
        finally:
            if process.returncode is None:
                process.kill()
                await process.wait()
        try:
            found = msgspec.json.decode(out, type=dict[str, str])
            return found["objection"]
        except (msgspec.MsgspecError, KeyError) as e:
            last = err.decode(errors="replace").strip().rpartition("\n")[2]
            raise Unreachable(f"it ended with code {process.returncode}: {last or 'without a word'}") from e


async def _talk_with(process: asyncio.subprocess.Process, question: bytes) -> tuple[bytes, bytes]:
    """Send `question` to the stdin of `process`, and return the last `MOST_KEPT` bytes of the process's stdout and stderr."""
    assert process.stdin is not None
    assert process.stdout is not None
    assert process.stderr is not None
    with suppress(ConnectionError):  # the process died, and its exit code tells more
        process.stdin.write(question)
        await process.stdin.drain()
    process.stdin.close()
    out, err, _ = await asyncio.gather(_end_of(process.stdout), _end_of(process.stderr), process.wait())
    return out, err


async def _end_of(stream: asyncio.StreamReader) -> bytes:
    kept = b""
    while data := await stream.read(MOST_KEPT):
        kept = (kept + data)[-MOST_KEPT:]
    return kept
