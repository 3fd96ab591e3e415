"""Broken pipes: the program that reads the output of fieldtwin has ended, as in `fieldtwin ... | head`, or because the log
of a service was restarted.

A run continues when the reader of stderr goes away, and keeps its exit code. The loss of stdout's reader does not change a
verdict either. Only a command that lists something ends when its reader goes away.
"""

from __future__ import annotations

import io
import os
import sys

VERDICTS = frozenset(
    {"run", "simulate", "test", "campaign", "check", "compare", "doctor", "template", "what-if", "with"}
)
"""Commands that end by themselves and whose exit code is a verdict."""


class _Pipe(io.FileIO):
    """The file of stdout or stderr: it drops output after the reader of the pipe has closed its end."""

    def write(self, data: object) -> int:
        try:
            return super().write(data)  # type: ignore[arg-type]  # whatever has bytes, as the class above says
        except BrokenPipeError:
            to_nowhere(self.fileno())
            return memoryview(data).nbytes  # type: ignore[arg-type]


def to_nowhere(*numbers: int) -> None:
    """Redirect these file descriptors to the null device, so that everything that is written to them is dropped."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for number in numbers:
        os.dup2(nowhere, number)
    os.close(nowhere)


def survive_broken_stderr() -> None:
    """Let the program continue without stderr when the reader of stderr has closed its end."""
    if (wrapped := _wrapped(sys.stderr, 2)) is not None:
        sys.stderr = wrapped


def survive_broken_stdout() -> None:
    """Let the program continue without stdout when the reader of stdout has closed its end, because the exit code still gives
    the verdict.
    """
    if (wrapped := _wrapped(sys.stdout, 1)) is not None:
        sys.stdout = wrapped


def _wrapped(stream: object, number: int) -> io.TextIOWrapper | None:
    """Return a stream that drops output after the reader has closed its end.

    Return None if `stream` does not belong to the process: in tests, or in a program that imports fieldtwin.
    """
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
