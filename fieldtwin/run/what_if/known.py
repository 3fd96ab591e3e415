"""Read the last known state of a plant from a knowledge store: an SQLite file, or PostgreSQL."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.gateway.store.event import Event, KnowledgeStore
from fieldtwin.gateway.store.knowledge import open_knowledge
from fieldtwin.run.what_if.last_known import LastKnown
from fieldtwin.run.what_if.state import KnownState
from fieldtwin.twin.site.system import System

RECENT = 100_000
"""Number of events read from the end of a log. A plant repeats unchanged values every ten seconds, so the last minutes
contain everything.
"""
BLOCK = 5_000


async def known_state(place: str, system: System, origin: str = "") -> KnownState:
    """Return the last known state of an origin in a knowledge store.

    Without `origin`, the store must have only one origin with tags or states. Raises `FileInvalid` or `UsageError`. If the last
    value of a tag was bad, no older one is used.
    """
    store = await open_knowledge(place)
    try:
        origins = list(await store.origins(system.name))
        if origin and origin not in origins:
            raise UsageError(f"no state is known of {origin!r}", expected=", ".join(origins) or "an origin with events")
        found = {}
        for name in [origin] if origin else origins:
            known = LastKnown(system)
            await recall(store, name, known.take)
            if known.utc_ms or origin:
                found[name] = known
        if not found and not origin:
            raise UsageError(f"{place} contains no state of {system.name}", expected="the last known state of a plant")
        if len(found) != 1:
            raise UsageError(
                "the origin of the knowledge is ambiguous",
                expected=", ".join(found),
                got="none",
                hint="--origin NAME",
            )
        [(name, known)] = found.items()
        return known.state(f"{place}: {name}")
    finally:
        await store.aclose()


async def recall(store: KnowledgeStore, origin: str, take: Callable[[Sequence[Event]], None]) -> None:
    """Pass the end of an origin's log in a store to `take`, block by block."""
    first, last = await store.span(origin)
    at = max(first, last - RECENT + 1)
    while at <= last:
        events = await store.read(origin, at, BLOCK)
        if not events:
            return
        take(events)
        at = events[-1].sequence + 1
