"""Let clients follow a gateway's tags: every change since the last request, and the current values of some tags.

Nothing is recorded before the first request. From then on the latest `MOST` changes are kept, and older ones are only counted.
"""

from __future__ import annotations

from collections import deque
from typing import Any

from fieldtwin.gateway.core.clock import Clock
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.gateway.core.values import TagValue
from fieldtwin.gateway.runtime.outputs.refusals import Refusals
from fieldtwin.gateway.runtime.tags import TagTable

MOST = 50_000
AT_ONCE = 10_000
"""The largest number of entries that fits into one line of the control channel."""
Change = tuple[int, int, str, Any, str, str]
"""A change of a tag: number (from 1), monotonic time (ns), tag, value (bytes as hex), quality, reason."""


class TagWatch:
    """The numbered changes of a `TagTable`. ``answer({"since": 0, "names": [...]})`` implements the control channel's `watch`."""

    def __init__(self, tags: TagTable, clock: Clock, journal: Refusals | None = None) -> None:
        self._journal = journal
        self._tags = tags
        self._clock = clock
        self._changes: deque[Change] = deque(maxlen=MOST)
        self._number = 0
        self._follows = False
        """Whether changes are recorded. Recording begins with the first request of a client."""

    def answer(self, args: dict[str, Any]) -> dict[str, Any]:
        """Return the answer to a `watch` question, with these keys:

        ``now_ns``; ``changes`` after number `since`, the oldest first, at most `AT_ONCE`; ``dropped``, how many of them
        are no longer kept; ``last``, the newest number; ``tags``, with value, quality, reason and source time (ns) of
        each of `names`; ``refusals``, the writes that did not reach their device, from the journal entry after number
        `refused` on.

        Raises `UsageError` for an unknown tag.
        """
        if not self._follows:
            self._tags.subscribe(self._changed)
            self._follows = True
        since, names, refused = args.get("since", 0), args.get("names", []), args.get("refused", 0)
        if type(since) is not int or type(refused) is not int or not isinstance(names, list):
            raise UsageError("what to watch", expected='{"since": NUMBER, "refused": NUMBER, "names": [TAG...]}')
        now_ns = self._clock.monotonic_ns()
        known = set(self._tags.names)
        for name in names:
            if name not in known:
                raise UsageError(f"no tag {name!r}")
        oldest = self._changes[0][0] if self._changes else self._number + 1
        return {
            "now_ns": now_ns,
            "last": self._number,
            "changes": self._after(since),
            "dropped": max(0, oldest - since - 1),
            "tags": {name: _shown(self._tags.current(name, now_ns)) for name in names},
            "refusals": [r.status() for r in self._journal.since(refused)] if self._journal is not None else [],
        }

    def _after(self, since: int) -> list[Change]:
        newer: list[Change] = []
        for change in reversed(self._changes):
            if change[0] <= since:
                break
            newer.append(change)
        return newer[::-1][:AT_ONCE]

    def _changed(self, name: str, value: TagValue) -> None:
        self._number += 1
        shown, quality, reason, _ = _shown(value)
        self._changes.append((self._number, self._clock.monotonic_ns(), name, shown, quality, reason))


def _shown(value: TagValue) -> tuple[Any, str, str, int]:
    raw = value.value.hex() if isinstance(value.value, bytes) else value.value
    return raw, str(value.quality), str(value.reason), value.t_ns
