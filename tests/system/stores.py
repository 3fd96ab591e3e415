"""Read the knowledge stores of a run while it runs, for the system tests."""

from __future__ import annotations

import sqlite3
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

Row = tuple[Any, ...]


def ask(path: Path, question: str, *what: str) -> list[Row]:
    """Query a store; return nothing if it does not exist yet."""
    with suppress(sqlite3.OperationalError), closing(sqlite3.connect(f"file:{path}?mode=ro", uri=True)) as db:
        return db.execute(question, what).fetchall()
    return []


def log_of(path: Path, origin: str) -> list[Row]:
    """Return an origin's events as they are stored, in order."""
    return ask(
        path,
        "SELECT sequence, t_ms, kind, text, typeof(value), value, quality, reason FROM event"
        " JOIN origin ON origin.id = event.origin JOIN event_name ON event_name.id = event.name"
        " WHERE origin.name = ? ORDER BY sequence",
        origin,
    )


def own(path: Path, side: str) -> str:
    """Return the origin under which that side writes; empty before it has one."""
    return next(
        (str(row[0]) for row in ask(path, "SELECT name FROM origin WHERE own AND name GLOB ?", f"{side}:*")), ""
    )
