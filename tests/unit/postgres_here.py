"""A PostgreSQL server of a test's own, from Debian's package: a new cluster, a Unix socket, no port."""

from __future__ import annotations

import os
import pwd
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

USER = "postgres"


def programs() -> Path | None:
    """Where initdb and postgres are, newest version first."""
    found = sorted(Path("/usr/lib/postgresql").glob("*/bin/initdb"), key=lambda p: int(p.parts[-3]), reverse=True)
    return found[0].parent if found else None


@contextmanager
def server() -> Iterator[str]:
    """Start a server; the URL of its database. Skips the test where there is none to start."""
    folder = programs()
    as_root = os.getuid() == 0
    if folder is None:
        pytest.skip("no PostgreSQL here (Debian: postgresql)")
    try:
        user = pwd.getpwnam(USER) if as_root else pwd.getpwuid(os.getuid())
    except KeyError:
        pytest.skip("PostgreSQL does not run as root, and there is no user postgres")
    place = Path(tempfile.mkdtemp(prefix="ftpg.", dir="/tmp"))
    if as_root:
        os.chown(place, user.pw_uid, user.pw_gid)
    run = {"user": user.pw_uid, "group": user.pw_gid, "extra_groups": []} if as_root else {}
    environment = {"PATH": "/usr/bin:/bin", "LC_ALL": "C", "HOME": str(place)}
    try:
        subprocess.run(
            [folder / "initdb", "-D", place / "db", "-U", USER, "-A", "trust", "--no-sync", "-E", "UTF8"],
            env=environment, cwd=place, check=True, capture_output=True, timeout=60, **run,
        )  # fmt: skip
        options = f"-k {place} -c listen_addresses='' -c fsync=off -c shared_buffers=16MB -c max_connections=20"
        control = [folder / "pg_ctl", "-D", place / "db", "-w", "-t", "30"]
        log = ["-l", place / "log", "-o", options]
        subprocess.run(
            [*control, *log, "start"], env=environment, cwd=place, check=True, capture_output=True, timeout=60, **run
        )
        try:
            yield f"postgresql://{USER}@/postgres?host={place}"
        finally:
            subprocess.run(
                [*control, "-m", "immediate", "stop"],
                env=environment,
                cwd=place,
                check=True,
                capture_output=True,
                timeout=60,
                **run,
            )
    finally:
        shutil.rmtree(place, ignore_errors=True)
