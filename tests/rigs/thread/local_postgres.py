"""A separate PostgreSQL server for a test, from Debian's package: a new cluster, a Unix socket, no port."""

from __future__ import annotations

import os
import pwd
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest

USER = "postgres"


def programs() -> Path | None:
    """The folders of initdb and postgres, newest version first."""
    found = sorted(Path("/usr/lib/postgresql").glob("*/bin/initdb"), key=lambda p: int(p.parts[-3]), reverse=True)
    return found[0].parent if found else None


class Cluster:
    """A cluster whose data directory is below `data`; its socket and log are in `place`."""

    def __init__(self, folder: Path, user: pwd.struct_passwd, place: Path, data: Path) -> None:
        self.url = f"postgresql://{USER}@/postgres?host={place}"
        self.log = place / "log"
        as_root = os.getuid() == 0
        self._as_user: dict[str, Any] = (
            {"user": user.pw_uid, "group": user.pw_gid, "extra_groups": []} if as_root else {}
        )
        self._folder, self._place, self._data = folder, place, data / "db"
        if as_root:
            for owned in (place, data):
                os.chown(owned, user.pw_uid, user.pw_gid)
        self._run(
            "initdb", "-D", self._data, "-U", USER, "-A", "trust", "--no-sync", "-E", "UTF8", "--wal-segsize", "1"
        )

    def _run(self, program: str, *words: str | Path) -> None:
        environment = {"PATH": "/usr/bin:/bin", "LC_ALL": "C", "HOME": str(self._place)}
        subprocess.run(
            [self._folder / program, *words],
            env=environment, cwd=self._place, check=True, capture_output=True, timeout=60, **self._as_user,
        )  # fmt: skip

    def start(self) -> None:
        options = f"-k {self._place} -c listen_addresses='' -c fsync=off -c shared_buffers=16MB -c max_connections=20"
        self._run("pg_ctl", "-D", self._data, "-w", "-t", "30", "-l", self.log, "-o", options, "start")

    def stop(self) -> None:
        self._run("pg_ctl", "-D", self._data, "-w", "-t", "30", "-m", "immediate", "stop")


@contextmanager
def cluster(data: Path | None = None) -> Iterator[Cluster]:
    """A running cluster. Skips the test if PostgreSQL is missing."""
    folder = programs()
    if folder is None:
        pytest.skip("no PostgreSQL here (Debian: postgresql)")
    try:
        user = pwd.getpwnam(USER) if os.getuid() == 0 else pwd.getpwuid(os.getuid())
    except KeyError:
        pytest.skip("PostgreSQL does not run as root, and there is no user postgres")
    place = Path(tempfile.mkdtemp(prefix="ftpg.", dir="/tmp"))
    try:
        made = Cluster(folder, user, place, data or place)
        made.start()
        try:
            yield made
        finally:
            with suppress(subprocess.CalledProcessError):  # it may have ended already
                made.stop()
    finally:
        shutil.rmtree(place, ignore_errors=True)


@contextmanager
def server() -> Iterator[str]:
    """Start a server; return the URL of its database. Skips the test if PostgreSQL is missing."""
    with cluster() as made:
        yield made.url
