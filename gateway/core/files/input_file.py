"""Open a file that a user named: a regular file of a limited size, so that reading it always ends.

Opening a pipe without a writer would block, a device such as /dev/zero has no end, and a sparse file of zeros would fill the
memory. A symbolic link is followed; its target must be a regular file.
"""

from __future__ import annotations

import errno
import io
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from fieldtwin.gateway.core.errors import FileInvalid

_KINDS = {
    stat.S_IFIFO: "a pipe",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a block device",
    stat.S_IFSOCK: "a socket",
}


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Raise `FileInvalid` with the path in place of an `OSError` of the block, which reads the file at `path`."""
    try:
        yield
    except OSError as e:
        raise FileInvalid(f"cannot be read: {e.strerror or e}", path=str(path)) from e


def open_input(path: Path) -> io.BufferedReader:
    """Open `path` for reading bytes. Raises `FileInvalid` if it is not a regular file, `OSError` if it cannot be opened."""
    # otherwise opening a pipe would wait for a writer
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)
    try:
        kind = stat.S_IFMT(os.fstat(descriptor).st_mode)
        if kind == stat.S_IFDIR:
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
        if kind != stat.S_IFREG:
            raise FileInvalid(
                "not a regular file", path=str(path), expected="a regular file", got=_KINDS.get(kind, "something else")
            )
        return open(descriptor, "rb")
    except BaseException:
        os.close(descriptor)
        raise


def read_input(path: Path, most_bytes: int) -> bytes:
    """Return the bytes of `path`. Raises as `open_input`, and `FileInvalid` if there are more than `most_bytes`."""
    with open_input(path) as file:
        if os.fstat(file.fileno()).st_size <= most_bytes:
            data = file.read(most_bytes + 1)
            if len(data) <= most_bytes:
                return data
    raise FileInvalid("the file is too large", path=str(path), expected=f"at most {most_bytes} bytes")
