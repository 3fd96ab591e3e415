"""The numbered schemas of the SQLite files of fieldtwin, and the migration of an old file.

Each version has a script in this folder. The script runs once, in the transaction that also stores the new version number, so a
file never has an intermediate state. A file that a newer fieldtwin wrote is not changed.
"""

from __future__ import annotations

import sqlite3
from importlib.resources import files
from pathlib import Path

from fieldtwin.gateway.core.errors import FileInvalid

SCRIPTS = {1: "0001_schema.sql", 2: "0002_knowledge.sql"}
LATEST = max(SCRIPTS)


def script(number: int) -> str:
    """Return the SQL script that leads to version `number`."""
    return files("fieldtwin.gateway.store").joinpath(SCRIPTS[number]).read_text(encoding="utf-8")


def refuse_newer(db: sqlite3.Connection, path: Path) -> int:
    """Return the version of the file; call it before the first change.

    Raises `FileInvalid` for a file that is newer than this program.
    """
    (version,) = db.execute("PRAGMA user_version").fetchone()
    if version > LATEST:
        raise FileInvalid(
            "the store was written by a newer fieldtwin",
            path=str(path),
            expected=f"schema {LATEST} or older",
            got=str(version),
            hint="the store was not changed",
        )
    return int(version)


def migrate(db: sqlite3.Connection, path: Path) -> None:
    """Migrate the file to the latest version.

    `db` is in autocommit mode. Raises `FileInvalid` for a file with a newer version.
    """
    for number in range(refuse_newer(db, path) + 1, LATEST + 1):
        try:
            db.executescript(f"BEGIN IMMEDIATE;{script(number)}PRAGMA user_version={number};COMMIT;")
        except sqlite3.DatabaseError:
            if db.in_transaction:
                db.execute("ROLLBACK")
            (now,) = db.execute("PRAGMA user_version").fetchone()
            if now < number:  # otherwise another process migrated it meanwhile
                raise
