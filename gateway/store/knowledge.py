"""Open a knowledge store (events of plants and twins): a SQLite file by its path, or a PostgreSQL database by its URL."""

from __future__ import annotations

from pathlib import Path

from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.gateway.core.url_secrets import has_password, without_password
from fieldtwin.gateway.store.event import KnowledgeStore
from fieldtwin.gateway.store.sqlite_knowledge import Offload, SqliteKnowledge
from fieldtwin.installation import install_hint

URLS = ("postgresql://", "postgres://")


def check_place(place: str) -> None:
    """Raise `UsageError` if a URL contains a password. The message does not repeat the password."""
    if place.startswith(URLS) and has_password(place):
        raise UsageError(
            "every user of this computer can read a password in a URL", got=without_password(place),
            hint="PGPASSWORD in the environment, or ~/.pgpass (PGPASSFILE)",
        )  # fmt: skip


async def open_knowledge(place: str, *, max_bytes: int = 0, offload: Offload | None = None) -> KnowledgeStore:
    """Open the store at a path or URL.

    `max_bytes` (0: no limit) and `offload` apply to SQLite files only; see `SqliteKnowledge`. Raises `Unreachable`,
    `FileInvalid`, `UsageError`.
    """
    if not place.startswith(URLS):
        return await SqliteKnowledge.open(Path(place), max_bytes=max_bytes, offload=offload)
    check_place(place)
    try:
        from fieldtwin.gateway.store.postgres_knowledge import PostgresKnowledge  # its library is an extra
    except ModuleNotFoundError as e:
        raise UsageError("PostgreSQL needs an extra", hint=install_hint("postgres")) from e
    return await PostgresKnowledge.open(place)
