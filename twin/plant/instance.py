"""An instance: one running system on this host, with its own run directory.

Sockets, virtual serial ports, process image, logs and store are in that directory, which only its owner may enter. Two
instances of one system can run at the same time, under different names; an instance name can be in use once only.
"""

from __future__ import annotations

import getpass
import os
import re
import stat
import tempfile
from pathlib import Path
from types import TracebackType
from typing import TextIO

from fieldtwin.gateway.core.errors import EndpointBusy, Unreachable, UsageError
from fieldtwin.gateway.core.files.port_marker import remove_dead_ports

try:
    import fcntl
except ImportError:  # Windows
    LOCKS = False
else:
    LOCKS = True

TEMPORARY = Path("/tmp")
BULK = Path("/var/tmp")
"""The folder for captures. They have many megabytes, and run directories are often on a file system in memory."""

SOCKET_PATH_MAX = 100
"""Longest path of a run directory plus file name. A Unix socket's path is at most 107 bytes (sockaddr_un)."""


def runtime_root() -> Path:
    """Return the folder for run directories: FIELDTWIN_RUN, else the user's runtime folder, else a folder of the user in /tmp.

    Raises `Unreachable` if the folder in /tmp was created by another user, or if other users may write to it.
    """
    if chosen := os.environ.get("FIELDTWIN_RUN"):
        return Path(chosen)
    if base := os.environ.get("XDG_RUNTIME_DIR"):
        return Path(base) / "fieldtwin"
    if not hasattr(os, "getuid"):  # Windows
        return Path(tempfile.gettempdir()) / f"fieldtwin-{getpass.getuser()}"
    folder = TEMPORARY / f"fieldtwin-{os.getuid()}"
    _refuse_foreign_folder(folder)
    return folder


def _refuse_foreign_folder(folder: Path) -> None:
    """Refuse a folder that another user owns or may write to.

    Any user may create a file in /tmp, and the folder's owner could replace its contents, sockets included.
    """
    try:
        found = folder.lstat()
    except FileNotFoundError:
        return
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.getuid() or found.st_mode & 0o022:
        raise Unreachable(
            "other users have access to the folder of the run directories",
            where=str(folder),
            expected="a folder that belongs to you, and that no other user may write to",
            got=f"{stat.filemode(found.st_mode)}, owner {found.st_uid}",
            hint="remove it, or set FIELDTWIN_RUN to a folder of yours",
        )


class Instance:
    """An instance with its locked directory: ``with Instance("observatory") as instance``.

    Raises `EndpointBusy` if it is in use.
    """

    def __init__(self, name: str, root: Path | None = None) -> None:
        if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]{0,39}", name):
            raise UsageError("an instance name", expected="1 to 40 letters, digits, . _ -", got=repr(name))
        self.name = name
        self.dir = (root or runtime_root()) / name
        self._lock: TextIO | None = None
        if len(str(self.dir)) > SOCKET_PATH_MAX - 12:
            raise UsageError(
                "the run directory's path is too long for sockets", got=str(self.dir), hint="set FIELDTWIN_RUN"
            )

    def __enter__(self) -> Instance:
        if not LOCKS:
            hint = "available on this system: emulate, record, read, scan, check, and simulate"
            raise Unreachable("a run needs Unix sockets and locks, which this system does not have", hint=hint)
        try:
            self.dir.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
            self.dir.mkdir(exist_ok=True, mode=0o700)
            found = self.dir.lstat()
            if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.getuid():
                raise Unreachable("the run directory belongs to a different user", where=str(self.dir))
            self._lock = (self.dir / "lock").open("w", encoding="utf-8")
        except OSError as e:
            raise Unreachable(f"cannot make the run directory: {e.strerror}", where=str(self.dir)) from e
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as e:
            self._lock.close()
            raise EndpointBusy(
                f"the instance {self.name!r} is running already", where=str(self.dir), hint="choose another --instance"
            ) from e
        remove_dead_ports(self.dir)
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        if self._lock is not None:
            self._lock.close()
            self._lock = None

    def path(self, name: str) -> Path:
        """Return the path of a file of this instance."""
        return self.dir / name


def capture_path(instance: str) -> Path:
    """Return where a run records the frames of its buses for Studio: with FIELDTWIN_RUN in the run directory, otherwise in
    a folder for large files that only this user may enter.

    Raises `Unreachable` if another user has access to that folder.
    """
    if os.environ.get("FIELDTWIN_RUN"):
        return runtime_root() / instance / "capture.jsonl"
    base = BULK if BULK.is_dir() else Path(tempfile.gettempdir())
    folder = base / f"fieldtwin-{os.getuid()}"
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
    except OSError as e:
        raise Unreachable(f"cannot make a folder for captures: {e.strerror}", where=str(folder)) from e
    _refuse_foreign_folder(folder)
    return folder / f"{instance}.capture.jsonl"
