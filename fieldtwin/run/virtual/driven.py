"""A run that is driven in virtual time: its folder, its trace, and its progress between two pieces.

This module must not depend on what runs. Everything in the run is sealed off from clocks, sockets and threads; the run
stops the loop when a piece is over.
"""

from __future__ import annotations

import asyncio
import tempfile
from abc import ABC, abstractmethod
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Protocol

from fieldtwin.emulators.virtual.chance import seeded
from fieldtwin.emulators.virtual.loop import VirtualLoop
from fieldtwin.emulators.virtual.seal import sealed
from fieldtwin.gateway.core.errors import FieldtwinError, FileInvalid, UsageError
from fieldtwin.results.trace import Trace, open_sink

TRACE_KEPT = 20_000
"""Events that stay in memory; the hash and a file have them all."""
PIECE_S = 10.0
"""Virtual seconds between two progress reports, and between two checks."""
MAX_ERRORS = 100


class Timed(Protocol):
    """The clock of a run."""

    def now_s(self) -> float: ...

    async def sleep_until_s(self, t_s: float) -> None: ...


class DrivenRun(ABC):
    """One run of `_main`: ``run()``, then `summary()`; errors are kept in `errors`."""

    faults: tuple[dict[str, Any], ...] = ()
    """The injected faults, including those that the seed chose."""

    def __init__(self, seed: int, duration_s: float, trace: Path | None) -> None:
        self.seed = seed
        self.elapsed_s = 0.0
        self.errors: list[str] = []
        self.trace = Trace(TRACE_KEPT)
        self._duration_s = duration_s
        self._trace_file = trace
        self._judged = False
        """False while the run cannot be judged: an error before that is a user's mistake and is raised."""

    @abstractmethod
    async def _main(self, loop: VirtualLoop, folder: Path) -> None:
        """Execute the run from start to end. `folder` is empty and is removed afterwards."""

    @abstractmethod
    def summary(self) -> dict[str, Any]:
        """Return plain data that does not depend on the speed of the run."""

    @property
    @abstractmethod
    def files(self) -> tuple[str, ...]:
        """Return the texts of the files that the run depends on, or their hashes; a changed file changes them."""

    def run(self, progress: Callable[[float], None] | None = None) -> None:
        """Run the system. `progress` is called from time to time with the elapsed virtual seconds.

        Raises `FileInvalid` where the trace cannot be written, and `UsageError` for options that make no sense in this
        system.
        """
        loop = VirtualLoop()
        with ExitStack() as stack:
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="ft-virtual-")))
            self.trace = Trace(TRACE_KEPT, open_sink(self._trace_file) if self._trace_file else None)
            stack.callback(self.trace.close)
            stack.callback(loop.close)
            stack.enter_context(seeded(self.seed))
            with sealed():
                main = loop.create_task(self._main(loop, folder), name="run")
                main.add_done_callback(lambda _: loop.stop())
            while not main.done():
                with sealed():
                    loop.run_forever()
                if progress is not None:
                    progress(self.elapsed_s)
            self._ended(main, loop)

    def _ended(self, main: asyncio.Task[None], loop: VirtualLoop) -> None:
        error = None if main.cancelled() else main.exception()
        if isinstance(error, FileInvalid | UsageError) and not self._judged:
            raise error
        if isinstance(error, FieldtwinError):
            self.errors.append(str(error))
        elif error is not None:
            raise error
        for context in loop.unhandled[:MAX_ERRORS]:
            self.errors.append(
                f"unhandled exception: {context.get('message')} {context.get('exception') or ''}".strip()
            )

    async def _through(self, bench: Timed, loop: VirtualLoop, judge: Callable[[], None]) -> None:
        """Advance to the end of the run's time, piece by piece."""
        while (left_s := self._duration_s - bench.now_s()) > 0:
            await bench.sleep_until_s(bench.now_s() + min(left_s, PIECE_S))
            self.elapsed_s = bench.now_s()
            judge()
            loop.stop()  # interrupt the loop to report progress
            await asyncio.sleep(0)
