"""The folder into which an FMU is unpacked. A folder that a killed process has left is removed at the next start of an FMU."""

from __future__ import annotations

import os
import shutil
import tempfile
from contextlib import suppress
from pathlib import Path

_PREFIX = "fieldtwin-fmu-"
_LOCK = ".lock"
"""The file that the owner keeps locked. The kernel releases the lock when the owner ends, however it ends."""


class UnpackedFolder:
    """A new folder `path` in the folder of temporary files, until `remove`. Raises `OSError` if it cannot be made."""

    def __init__(self) -> None:
        _remove_left()
        self.path = Path(tempfile.mkdtemp(prefix=_PREFIX))
        beside = self.path / f"{_LOCK}.new"  # locked before another process can find it
        self._lock = os.open(beside, os.O_WRONLY | os.O_CREAT | os.O_CLOEXEC, 0o600)
        _lock(self._lock)
        beside.rename(self.path / _LOCK)

    def remove(self) -> None:
        """Remove the folder with its contents."""
        shutil.rmtree(self.path, ignore_errors=True)
        os.close(self._lock)


def _remove_left() -> None:
    """Remove the folders of this user whose owners have ended. A folder without a lock file is being made."""
    for folder in Path(tempfile.gettempdir()).glob(f"{_PREFIX}*"):
        with suppress(OSError):  # folders of other users, and of owners that still run
            lock = os.open(folder / _LOCK, os.O_WRONLY | os.O_NOFOLLOW | os.O_CLOEXEC)
            try:
                _lock(lock)
                shutil.rmtree(folder, ignore_errors=True)
            finally:
                os.close(lock)


def _lock(descriptor: int) -> None:
    import fcntl  # not on Windows

    fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
