"""A run that is driven in virtual time: its folder, its trace, and between two of its pieces a look at the world.

It must never know what runs. Everything of the run is sealed off from clocks, sockets and threads; the run stops the loop when
a piece is over.
"""

from __future__ import annotations

import asyncio
import tempfile
from collections.abc import Callable, Coroutine
from contextlib import ExitStack
from pathlib import Path
from typing import Any, BinaryIO

from emulators.virtual.loop import VirtualLoop
from emulators.virtual.seal import sealed
from fieldtwin.scenarios.trace import Trace, open_sink

TRACE_KEPT = 20_000
"""Events that stay in memory; the hash and a file have them all."""


def drive(
    begin: Callable[[VirtualLoop, Path, Trace], Coroutine[Any, Any, None]],
    ended: Callable[[asyncio.Task[None], VirtualLoop], None],
    *,
    trace: Path | None = None,
    between: Callable[[], None] | None = None,
) -> None:
    """Run what `begin` gives for a loop, an empty folder and a trace, to its end; then `ended` is told, while both are there.

    `trace` is a file for every event, `between` is called after each piece. Raises what `ended` raises, and `FileInvalid` when
    the file cannot be written.
    """
    loop = VirtualLoop()
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="ft-virtual-")))
        sink: BinaryIO | None = stack.enter_context(open_sink(trace)) if trace is not None else None
        stack.callback(loop.close)
        with sealed():
            main = loop.create_task(begin(loop, folder, Trace(TRACE_KEPT, sink)), name="run")
            main.add_done_callback(lambda _: loop.stop())
        while not main.done():
            with sealed():
                loop.run_forever()
            if between is not None:
                between()
        ended(main, loop)
