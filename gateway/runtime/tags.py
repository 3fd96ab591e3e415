"""The tag table: every tag's newest value, and the journal of values that were published as good.

A value that was not refreshed within its device's `stale_after_ms` is returned as bad, even if it was last published as
good.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection

import msgspec
from msgspec.structs import replace

from fieldtwin.gateway.core.clock import NS_PER_MS, Clock
from fieldtwin.gateway.core.values import NEVER, Quality, Reason, Scalar, TagValue

FOREVER_NS = 2**63 - 1
JOURNAL = 100_000
"""The largest number of published values kept until the store fetches them. Older values are dropped and counted."""
OnPut = Callable[[str, TagValue], None]
"""A function that is called with a tag's name and its new value. It must not raise."""
_GOOD, _BAD = Quality.GOOD, Quality.BAD  # local names, because looking up an Enum's members is slow


class Published(msgspec.Struct, frozen=True, gc=False):
    """A good value that was published: number (from 1), tag, bytes that the device sent, engineering value, source time (ns)."""

    number: int
    tag: str
    raw: bytes
    value: Scalar | None
    t_ns: int


class Held:
    """The table's own entry for one tag."""

    __slots__ = ("limit_ns", "name", "refreshed_ns", "value")

    def __init__(self, name: str) -> None:
        self.name = name
        self.value = NEVER
        self.refreshed_ns = 0
        self.limit_ns: int | None = None
        """The time for which the value is good without being refreshed, in ns."""

    @property
    def fresh_until_ns(self) -> int:
        """Return the time after which the value is stale, see `TagTable.fresh_until_ns`."""
        return FOREVER_NS if self.limit_ns is None else self.refreshed_ns + self.limit_ns

    def as_of(self, now_ns: int) -> TagValue:
        """Return the value as of `now_ns`, see `TagTable.current`."""
        value, limit = self.value, self.limit_ns
        if limit is None or value.quality is _BAD or now_ns - self.refreshed_ns <= limit:
            return value
        return replace(value, quality=_BAD, reason=Reason.STALE)


class TagTable:
    """The values by full tag name. Drivers write them (`TagSink`); the process image, the status and the data store read them."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._held: dict[str, Held] = {}
        self.news: dict[str, Held] = {}
        """The tags that were stored since the last `take_changes`."""
        self._journal: deque[tuple[str, TagValue]] = deque(maxlen=JOURNAL)
        self._subscriptions: dict[object, OnPut] = {}
        self._subscribers: tuple[OnPut, ...] = ()
        """The values of `_subscriptions`; a tuple, so that a subscriber may unsubscribe while it is called."""
        self.published = 0

    def subscribe(self, on_put: OnPut) -> Callable[[], None]:
        """Call `on_put` with every value whose sample, bytes or quality differ from the last one, after earlier
        subscribers. Return the function that ends the subscription; it does nothing the second time."""
        subscription = object()

        def unsubscribe() -> None:
            self._subscriptions.pop(subscription, None)
            self._subscribers = tuple(self._subscriptions.values())

        self._subscriptions[subscription] = on_put
        self._subscribers = tuple(self._subscriptions.values())
        return unsubscribe

    def _of(self, name: str) -> Held:
        held = self._held.get(name)
        if held is None:
            held = self._held[name] = Held(name)
        return held

    def declare(self, names: list[str], stale_after_ms: int | None) -> None:
        """Add tags.

        A value that is not refreshed for `stale_after_ms` becomes bad; None is for values that do not age (an identity).
        """
        for name in names:
            held = self.news[name] = self._of(name)
            held.limit_ns = None if stale_after_ms is None else stale_after_ms * NS_PER_MS

    def restate(self, name: str, stale_after_ms: int | None) -> None:
        """Set a new age limit for a tag.

        A fresh value counts as refreshed now, so that the change itself does not make it stale.
        """
        now_ns = self._clock.monotonic_ns()
        limit = None if stale_after_ms is None else stale_after_ms * NS_PER_MS
        held = self._of(name)
        if limit == held.limit_ns:
            return
        if self.current(name, now_ns).quality is not _BAD:
            held.refreshed_ns = now_ns
        self.declare([name], stale_after_ms)

    def amend(self, name: str, value: TagValue) -> None:
        """Replace a tag's value by a new interpretation of the same bytes. Its age stays; the change is reported like
        any other."""
        held = self.news[name] = self._of(name)
        before, held.value = held.value, value
        if self._subscribers and value != before:
            for on_put in self._subscribers:
                on_put(name, value)

    @property
    def names(self) -> list[str]:
        return list(self._held)

    def __contains__(self, name: str) -> bool:
        return name in self._held

    def put(self, name: str, value: TagValue) -> None:
        """Store the newest value of a tag. A good value is added to the journal if its sample or its bytes differ."""
        try:
            held = self._held[name]
        except KeyError:
            held = self._of(name)
        before = held.value
        held.value = value
        held.refreshed_ns = self._clock.monotonic_ns()
        self.news[name] = held
        if value.quality is not _GOOD:
            if value.quality is not before.quality:
                for on_put in self._subscribers:
                    on_put(name, value)
        elif value.t_ns != before.t_ns or value.raw != before.raw or before.quality is not _GOOD:
            self.published += 1
            self._journal.append((name, value))
            for on_put in self._subscribers:
                on_put(name, value)

    def put_bad(self, names: list[str], reason: Reason) -> None:
        """Mark the tags as bad from now on; their last value and its time stay readable."""
        for name in names:
            held = self._of(name)
            before = held.value
            if before.quality is not _BAD or before.reason is not reason:
                held.value = replace(before, quality=_BAD, reason=reason)
                self.news[name] = held
                for on_put in self._subscribers:
                    on_put(name, held.value)

    def current(self, name: str, now_ns: int) -> TagValue:
        """Return the value of a tag as of `now_ns`: bad with reason STALE if it was not refreshed in time.

        A tag that is not read (one that can only be written) has the reason NEVER_READ.
        """
        held = self._held.get(name)
        return NEVER if held is None else held.as_of(now_ns)

    def held(self, name: str) -> TagValue:
        """Return the value that was stored last, without a check of its age."""
        held = self._held.get(name)
        return NEVER if held is None else held.value

    def entry(self, name: str) -> Held | None:
        """Return the table's own entry of a tag, which always holds its newest value; None for a tag that the table does not
        have.
        """
        return self._held.get(name)

    def fresh_until_ns(self, name: str) -> int:
        """Return the time after which the tag is stale unless it is refreshed; `FOREVER_NS` if it never becomes stale."""
        held = self._held.get(name)
        return FOREVER_NS if held is None else held.fresh_until_ns

    def take_changes(self) -> Collection[Held]:
        """Return the tags that were stored since the last call. Only one reader, which mirrors the table, may call this."""
        if not self.news:
            return ()
        news, self.news = self.news, {}
        return news.values()

    @property
    def journal_dropped(self) -> int:
        """Return the number of entries that were dropped from the journal."""
        return self.published - len(self._journal)

    def journal_since(self, number: int) -> list[Published]:
        """Return the journal's entries after `number` that are still kept."""
        newer: list[Published] = []
        for at, (name, value) in zip(range(self.published, number, -1), reversed(self._journal), strict=False):
            newer.append(Published(at, name, value.raw, value.value, value.t_ns))
        return newer[::-1]
