"""Opening the knowledge, whatever keeps it: a file's path, or the URL of a PostgreSQL database."""

from __future__ import annotations

from pathlib import Path

from gateway.core.errors import UsageError
from gateway.store.event import KnowledgeStore
from gateway.store.sqlite_knowledge import Offload, SqliteKnowledge

URLS = ("postgresql://", "postgres://")


async def open_knowledge(place: str, *, max_bytes: int = 0, offload: Offload | None = None) -> KnowledgeStore:
    """A store at a path or URL. `max_bytes` and `offload` are for files. Raises `Unreachable`, `FileInvalid`, `UsageError`."""
    if not place.startswith(URLS):
        return await SqliteKnowledge.open(Path(place), max_bytes=max_bytes, offload=offload)
    try:
        from gateway.store.postgres_knowledge import PostgresKnowledge  # an extra
    except ModuleNotFoundError as e:
        raise UsageError("PostgreSQL needs an extra", hint="pip install 'fieldtwin[postgres]'") from e
    return await PostgresKnowledge.open(place)
