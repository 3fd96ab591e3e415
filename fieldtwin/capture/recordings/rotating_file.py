"""A file of lines that may grow for days, divided into parts of a bounded size.

Each line is one write, so that a process that is killed loses at most one line. ``r.jsonl`` is followed by ``r.0001.jsonl``,
``r.0002.jsonl`` and so on, each with the header of the first. Times continue over the parts, which `parts_of` finds. This
module must not depend on the content of the lines, nor on a clock.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import Self

from fieldtwin.gateway.core.errors import Bug, FileInvalid
from fieldtwin.gateway.core.files.recording import RecordedExchange, RecordingHeader, RecordingReader

MAX_PARTS = 9999
MB = 1_000_000
_NEW = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_APPEND | getattr(os, "O_CLOEXEC", 0) | getattr(os, "O_BINARY", 0)
"""The flags with which a new file is opened. O_CLOEXEC and O_BINARY each exist on only some operating systems."""


class RotatingFile:
    """A file that appends lines to `path` and its further parts. An existing part is never overwritten.

    A new part begins when `max_bytes` would be exceeded, or with the first line `max_s` seconds after the first line of the
    current part (0: never). At most `keep` parts are kept (0: all) and the oldest are removed; `removed` counts the removed
    parts. Raises `FileInvalid` when a part exists already or writing fails; all earlier lines are then complete in the file. Used
    as a context manager, it leaves no file if an error ends the block before the first line, so that the name can be used again.
    """

    def __init__(
        self, path: Path, head: bytes = b"", *, max_bytes: int = 256 * MB, max_s: float = 0.0, keep: int = 0
    ) -> None:
        if max_bytes < len(head) + 1 or max_s < 0 or keep < 0:
            raise Bug("a rotating file's limits", expected="positive ones", got=f"{max_bytes} bytes, {max_s} s, {keep}")
        self.path = path
        self.parts: list[Path] = []
        self.lines = 0
        self.removed = 0
        self._head = head
        self._max_bytes, self._max_s, self._keep = max_bytes, max_s, keep
        self._number = 0
        self._fd = -1
        self._size = 0
        self._began_s: float | None = None
        self._open(path)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self.close()
        if error is not None and not self.lines:
            self.path.unlink(missing_ok=True)

    def line(self, t_s: float, line: bytes) -> None:
        """Append `line` (newline included), whose time is `t_s`."""
        if self._fd < 0:
            raise Bug("a closed file was written to", where=str(self.path))
        self._began_s = t_s if self._began_s is None else self._began_s
        full = self._size + len(line) > self._max_bytes and self._size > len(self._head)
        if full or (self._max_s and t_s - self._began_s >= self._max_s):
            self._next()
            self._began_s = t_s
        self._write(line)
        self.lines += 1

    def close(self) -> None:
        """Close the last part; closing twice does nothing."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1

    def _next(self) -> None:
        self.close()
        self._number += 1
        if self._number > MAX_PARTS:
            raise FileInvalid("too many parts", path=str(self.path), expected=str(MAX_PARTS), hint="larger parts")
        self._open(part(self.path, self._number))
        while self._keep and len(self.parts) > self._keep:
            self.parts.pop(0).unlink(missing_ok=True)
            self.removed += 1

    def _open(self, path: Path) -> None:
        try:
            self._fd = os.open(path, _NEW, 0o644)
        except FileExistsError:
            raise FileInvalid("the recording exists already", path=str(path), hint="choose another name") from None
        except OSError as e:
            raise FileInvalid(f"cannot write the recording: {e.strerror}", path=str(path)) from e
        self.parts.append(path)
        self._size = 0
        if self._head:
            self._write(self._head)

    def _write(self, line: bytes) -> None:
        try:
            done = os.write(self._fd, line)
            while done < len(line):
                done += os.write(self._fd, line[done:])
        except OSError as e:
            os.ftruncate(self._fd, self._size)
            raise FileInvalid(f"cannot continue writing: {e.strerror}", path=str(self.parts[-1])) from e
        self._size += len(line)


def part(path: Path, number: int) -> Path:
    """Return the name of a recording's part; number 0 is the recording itself."""
    return path.with_name(f"{path.stem}.{number:04d}{path.suffix}") if number else path


def parts_of(path: Path) -> list[Path]:
    """Return the existing parts of the recording at `path`, the oldest first.

    A last part without a header does not count: its recorder was killed after creating the file and before writing to it.
    """
    numbers = sorted(
        int(name)
        for at in path.parent.glob(f"{_escaped(path.stem)}.[0-9][0-9][0-9][0-9]{path.suffix}")
        if (name := at.name[len(path.stem) + 1 : len(path.stem) + 5]).isdigit()
    )
    found = [*([path] if path.is_file() or not numbers else []), *(part(path, n) for n in numbers)]
    return found if len(found) == 1 or found[-1].stat().st_size else found[:-1]


def oldest_part(path: Path) -> Path:
    """Return the first part of the recording that still exists."""
    return parts_of(path)[0]


def header_of(path: Path) -> RecordingHeader:
    """Return the header of the recording at `path`. Raises `FileInvalid`."""
    with RecordingReader(oldest_part(path)) as reader:
        return reader.header


def exchanges_of(path: Path) -> Iterator[RecordedExchange]:
    """Yield the exchanges of all parts of a recording, in order. Raises `FileInvalid`."""
    for found in parts_of(path):
        with RecordingReader(found) as reader:
            yield from reader.exchanges()


def _escaped(text: str) -> str:
    return "".join(f"[{c}]" if c in "*?[" else c for c in text)
