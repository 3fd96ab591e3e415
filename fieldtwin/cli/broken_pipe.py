"""What becomes of a command whose reader is gone: `fieldtwin ... | head`, or a service's log that was started again.

Who stops reading the talk on stderr ends nothing by that: a run goes on, and its exit code is its own. Who stops reading stdout
changes no verdict. Only a listing is over when its reader has what it wanted.
"""

from __future__ import annotations

import io
import os
import sys

VERDICTS = frozenset({"run", "test", "check", "compare", "doctor", "template", "what-if", "with"})
"""Commands that end by themselves, and whose exit code says more than that they did."""


class _Pipe(io.FileIO):
    """One of our two streams: what is written behind its reader's end goes nowhere."""

    def write(self, data: object) -> int:
        try:
            return super().write(data)  # type: ignore[arg-type]  # whatever has bytes, as the class above says
        except BrokenPipeError:
            to_nowhere(self.fileno())
            return memoryview(data).nbytes  # type: ignore[arg-type]


def to_nowhere(*numbers: int) -> None:
    """From now on what is written to these files of ours is dropped."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for number in numbers:
        os.dup2(nowhere, number)
    os.close(nowhere)


def talk_unheard() -> None:
    """From now on the end of who reads stderr is nothing to us."""
    if (wrapped := _wrapped(sys.stderr, 2)) is not None:
        sys.stderr = wrapped


def verdict_unheard() -> None:
    """From now on the end of who reads stdout is nothing to us either: the exit code tells."""
    if (wrapped := _wrapped(sys.stdout, 1)) is not None:
        sys.stdout = wrapped


def _wrapped(stream: object, number: int) -> io.TextIOWrapper | None:
    """None where the stream is not the process's own: a test's, or of somebody who imports us."""
    try:
        if not isinstance(stream, io.TextIOWrapper) or stream.fileno() != number:
            return None
    except io.UnsupportedOperation:
        return None
    stream.flush()
    pipe = _Pipe(number, "w", closefd=False)
    return io.TextIOWrapper(
        io.BufferedWriter(pipe),
        encoding=stream.encoding,
        errors=stream.errors,
        line_buffering=number == 2 or stream.line_buffering,
    )
