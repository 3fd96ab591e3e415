"""The tag table: every tag's newest value, and the journal of what was published as good.

A value that nobody refreshed for its device's `stale_after_ms` is bad when it is looked at, whoever last called it good.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

import msgspec
from msgspec.structs import replace

from gateway.core.clock import NS_PER_MS, Clock
from gateway.core.values import NEVER, Quality, Reason, Scalar, TagValue

FOREVER_NS = 2**63 - 1
JOURNAL = 100_000
"""Published values that are kept until somebody fetches them; the oldest are dropped and counted."""


class Published(msgspec.Struct, frozen=True, gc=False):
    """A good value as it was published: number (from 1), tag, what the device sent, engineering value, source time."""

    number: int
    tag: str
    raw: bytes
    value: Scalar | None
    t_ns: int


class TagTable:
    """Values by full tag name. `TagSink` for the drivers, a source for image, status and store."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._values: dict[str, TagValue] = {}
        self._refreshed_ns: dict[str, int] = {}
        self._stale_ns: dict[str, int] = {}
        self._news: dict[str, None] = {}
        self._journal: deque[Published] = deque(maxlen=JOURNAL)
        self.on_put: Callable[[str, TagValue], None] | None = None
        """Told of every value that is another sample, other bytes or of another quality than the last. It may not raise."""
        self.published = 0
        self.journal_dropped = 0

    def declare(self, names: list[str], stale_after_ms: int | None) -> None:
        """Make tags known. A value not refreshed for `stale_after_ms` is bad; None for what does not age (an identity)."""
        for name in names:
            self._values.setdefault(name, NEVER)
            self._news[name] = None
            if stale_after_ms is not None:
                self._stale_ns[name] = stale_after_ms * NS_PER_MS
            else:
                self._stale_ns.pop(name, None)

    def restate(self, name: str, stale_after_ms: int | None) -> None:
        """Another limit for a tag. What is fresh is not made stale by that: it counts as refreshed now, once."""
        now_ns = self._clock.monotonic_ns()
        limit = None if stale_after_ms is None else stale_after_ms * NS_PER_MS
        if limit == self._stale_ns.get(name):
            return
        if self.current(name, now_ns).quality is not Quality.BAD:
            self._refreshed_ns[name] = now_ns
        self.declare([name], stale_after_ms)

    def amend(self, name: str, value: TagValue) -> None:
        """What a tag holds, understood in another way: no newer, and told as any other change."""
        before = self._values.get(name, NEVER)
        self._values[name] = value
        self._news[name] = None
        if self.on_put is not None and value != before:
            self.on_put(name, value)

    @property
    def names(self) -> list[str]:
        return list(self._values)

    def put(self, name: str, value: TagValue) -> None:
        """The newest value of a tag. A good one is journalled when it is another sample or other bytes."""
        before = self._values.get(name, NEVER)
        self._values[name] = value
        self._refreshed_ns[name] = self._clock.monotonic_ns()
        self._news[name] = None
        if value.quality is Quality.GOOD and (value.t_ns != before.t_ns or value.raw != before.raw or not before.good):
            self.published += 1
            self.journal_dropped += len(self._journal) == JOURNAL
            self._journal.append(Published(self.published, name, value.raw, value.value, value.t_ns))
            if self.on_put is not None:
                self.on_put(name, value)
        elif self.on_put is not None and value.quality is not before.quality:
            self.on_put(name, value)

    def put_bad(self, names: list[str], reason: Reason) -> None:
        """The tags are bad from now on; their last value and its time stay readable."""
        for name in names:
            before = self._values.get(name, NEVER)
            if before.quality is not Quality.BAD or before.reason is not reason:
                value = self._values[name] = replace(before, quality=Quality.BAD, reason=reason)
                self._news[name] = None
                if self.on_put is not None:
                    self.on_put(name, value)

    def current(self, name: str, now_ns: int) -> TagValue:
        """The value of a tag as of `now_ns`: bad with reason STALE when it was not refreshed in time.

        A tag that nobody reads (one that can only be written) was never read.
        """
        value = self._values.get(name, NEVER)
        limit = self._stale_ns.get(name)
        if limit is None or value.quality is Quality.BAD or now_ns - self._refreshed_ns.get(name, 0) <= limit:
            return value
        return replace(value, quality=Quality.BAD, reason=Reason.STALE)

    def held(self, name: str) -> TagValue:
        """The value as it was put last, however old."""
        return self._values.get(name, NEVER)

    def fresh_until_ns(self, name: str) -> int:
        """From when on `current` says STALE unless the tag is refreshed; beyond all time where it never does."""
        limit = self._stale_ns.get(name)
        return FOREVER_NS if limit is None else self._refreshed_ns.get(name, 0) + limit

    def take_news(self) -> list[str]:
        """The tags that were put since the last call, for the one who mirrors the table."""
        if not self._news:
            return []
        news = list(self._news)
        self._news.clear()
        return news

    def journal_since(self, number: int) -> list[Published]:
        """What was published as good after entry `number`, as far as it is still kept."""
        newer: list[Published] = []
        for entry in reversed(self._journal):
            if entry.number <= number:
                break
            newer.append(entry)
        return newer[::-1]
