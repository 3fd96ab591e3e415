"""Unpack gzip and bzip2 files, up to a limit: a few kilobytes of either can expand to gigabytes.

The limit protects against long reading times, which the packed file would otherwise determine. It is not needed for memory,
because unpacked data is read in pieces.
"""

from __future__ import annotations

import bz2
import gzip
import io
import os
from pathlib import Path
from typing import BinaryIO

from fieldtwin.gateway.core.errors import FileInvalid

FREE_BYTES = 64 * 1024 * 1024
"""Number of bytes that any packed file may expand to."""
MOST_TIMES = 100
"""A larger file may expand to this multiple of its own size. Real captures and casts stay below 50 times."""


def most_unpacked(packed_bytes: int) -> int:
    """Return how many bytes a packed file of this size may hold."""
    return max(FREE_BYTES, MOST_TIMES * packed_bytes)


def too_much(path: Path, packed_bytes: int) -> FileInvalid:
    """Return the error for a packed file that holds more than `most_unpacked` allows."""
    expected = f"at most {most_unpacked(packed_bytes)} bytes ({FREE_BYTES >> 20} MiB, or {MOST_TIMES} times its size)"
    hint = "if the file is yours, unpack it and give the unpacked file"
    return FileInvalid("the unpacked file is too large", path=str(path), expected=expected, hint=hint)


def unpacked(raw: io.BufferedReader, path: Path) -> BinaryIO | None:
    """Return a reader of the unpacked content of `raw`; None if its first bytes show neither gzip nor bzip2.

    The reader raises `FileInvalid` beyond `most_unpacked`, and `OSError`, `EOFError` or `zlib.error` if the data is damaged.
    """
    magic = raw.peek(3)[:3]
    if magic[:2] == b"\x1f\x8b":
        return io.BufferedReader(_Limited(gzip.GzipFile(fileobj=raw), raw, path))
    if magic == b"BZh":
        return io.BufferedReader(_Limited(bz2.BZ2File(raw), raw, path))
    return None


class _Limited(io.RawIOBase):
    """A reader of the unpacked bytes that counts them and refuses more than the limit."""

    def __init__(self, packed: gzip.GzipFile | bz2.BZ2File, raw: io.BufferedReader, path: Path) -> None:
        self._packed, self._path = packed, path
        self._size = os.fstat(raw.fileno()).st_size
        self._left = most_unpacked(self._size)

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: memoryview) -> int:  # type: ignore[override]
        data = self._packed.read1(len(buffer))
        self._left -= len(data)
        if self._left < 0:
            raise too_much(self._path, self._size)
        buffer[: len(data)] = data
        return len(data)

    def close(self) -> None:
        self._packed.close()
        super().close()
