"""Let clients follow a gateway's tags: the changes since a number, every sample since a number, and the values of some tags.

Changes are kept from the creation of the `TagWatch` on, so that a client that connects late still gets the earlier ones. Samples
are kept from the first request for them on.
"""

from __future__ import annotations

from collections import deque
from itertools import islice
from typing import Any

from fieldtwin.gateway.core.clock import Clock
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.gateway.core.values import NEVER, TagValue
from fieldtwin.gateway.runtime.alarms.alarm_list import AlarmList
from fieldtwin.gateway.runtime.outputs.refusals import Refusals
from fieldtwin.gateway.runtime.tags import TagTable

MOST_CHANGES = 50_000
"""The largest number of changes that are kept, of all tags together: about 13 MB. The oldest ones are dropped first."""
MOST_SAMPLES = 50_000
"""The largest number of samples that are kept, of all tags together."""
AT_ONCE = 10_000
"""The largest number of entries that fits into one line of the control channel."""
Entry = tuple[int, int, str, Any, str, str]
"""A change or sample: number (from 1), monotonic time (ns), tag, value (bytes as hex), quality, reason."""


class TagWatch:
    """The numbered changes of a `TagTable`. ``answer({"since": 0, "names": [...]})`` implements the control channel's `watch`."""

    def __init__(
        self, tags: TagTable, clock: Clock, journal: Refusals | None = None, alarms: AlarmList | None = None
    ) -> None:
        self._journal = journal
        self._alarms = alarms
        self._tags = tags
        self._clock = clock
        self._began_ns = clock.monotonic_ns()
        self._changes = _Ring(MOST_CHANGES)
        self._samples: _Ring | None = None
        self._latest: dict[str, TagValue] = {}
        tags.subscribe(self._put)

    def answer(self, args: dict[str, Any]) -> dict[str, Any]:
        """Return the answer to a `watch` question, with these keys:

        ``now_ns``; ``began_ns``, since when changes are kept; ``changes`` after number `since`, the oldest first, at most
        `AT_ONCE`, none if `since` is None; ``dropped``, how many of them are no longer kept; ``last``, the newest number;
        ``tags``, with value, quality, reason and source time (ns) of each of `names`; ``refusals``, the writes that did not
        reach their device, from the journal entry after number `refused` on; ``alarms``, the changes of alarms after number
        `alarms`, none if it is None.

        A change is a value, quality or reason that differs from the last one of its tag. With ``"samples": true`` the entries
        are all samples instead, equal ones too, with numbers of their own.

        Raises `UsageError` for an unknown tag.
        """
        since, names, refused = args.get("since"), args.get("names", []), args.get("refused", 0)
        alarms = args.get("alarms")
        numbers = all(number is None or type(number) is int for number in (since, alarms)) and type(refused) is int
        if not numbers or not isinstance(names, list):
            raise UsageError(
                "what to watch",
                expected='{"since": NUMBER or null, "samples": true or false, "refused": NUMBER, "alarms": NUMBER or null, '
                '"names": [TAG...]}',
            )
        now_ns = self._clock.monotonic_ns()
        for name in names:
            if name not in self._tags:
                raise UsageError(f"no tag {name!r}")
        if args.get("samples") is True and self._samples is None:
            self._samples = _Ring(MOST_SAMPLES)
        ring = self._samples if self._samples is not None and args.get("samples") is True else self._changes
        return {
            "now_ns": now_ns,
            "began_ns": self._began_ns,
            "last": ring.last,
            "changes": [] if since is None else ring.after(since),
            "dropped": 0 if since is None else max(0, ring.oldest - since - 1),
            "tags": {name: _shown(self._tags.current(name, now_ns)) for name in names},
            "refusals": [r.status() for r in self._journal.since(refused)] if self._journal is not None else [],
            "alarms": [] if self._alarms is None or alarms is None else self._alarms.events_since(alarms),
        }

    def _put(self, name: str, value: TagValue) -> None:
        before = self._latest.get(name, NEVER)
        if value.value != before.value or value.quality is not before.quality or value.reason is not before.reason:
            self._changes.add((self._clock.monotonic_ns(), name, value))
            self._latest[name] = value
        if self._samples is not None:
            self._samples.add((self._clock.monotonic_ns(), name, value))


class _Ring:
    """The latest entries of a sequence, each with its monotonic time (ns) and its tag. Numbers begin with 1."""

    def __init__(self, most: int) -> None:
        self._kept: deque[tuple[int, str, TagValue]] = deque(maxlen=most)
        self.last = 0

    @property
    def oldest(self) -> int:
        """Return the number of the oldest entry that is kept, or of the next entry if none is kept."""
        return self.last - len(self._kept) + 1

    def add(self, entry: tuple[int, str, TagValue]) -> None:
        self.last += 1
        self._kept.append(entry)

    def after(self, number: int) -> list[Entry]:
        """Return the entries after `number` that are still kept, the oldest first, at most `AT_ONCE`."""
        newer = list(islice(reversed(self._kept), max(0, self.last - number)))[: -AT_ONCE - 1 : -1]
        first = max(self.oldest, number + 1)
        return [(n, t_ns, name, *_shown(value)[:3]) for n, (t_ns, name, value) in enumerate(newer, first)]


def _shown(value: TagValue) -> tuple[Any, str, str, int]:
    raw = value.value.hex() if isinstance(value.value, bytes) else value.value
    return raw, str(value.quality), str(value.reason), value.t_ns
