"""Subscriptions to the tag table: several subscribers, their order, their end, and what is reported to them."""

from __future__ import annotations

from fieldtwin.gateway.core.values import Quality, Reason, TagValue
from fieldtwin.gateway.runtime.tags import TagTable
from fieldtwin.twin.plant.watching import TagWatch


class Clock:
    """A clock that stands still."""

    def monotonic_ns(self) -> int:
        return 5

    def utc_ns(self) -> int:
        return 5

    async def sleep_until_ns(self, t_ns: int) -> None:
        raise AssertionError("nothing sleeps here")


def good(number: int) -> TagValue:
    return TagValue(number, Quality.GOOD, Reason.NONE, number, number.to_bytes(2))


def table() -> TagTable:
    made = TagTable(Clock())
    made.declare(["d.a"], None)
    return made


def test_each_subscriber_gets_each_change_in_the_order_of_subscription() -> None:
    tags, seen = table(), list[tuple[str, object]]()
    tags.subscribe(lambda name, value: seen.append(("first", value.value)))
    tags.subscribe(lambda name, value: seen.append(("second", value.value)))
    tags.put("d.a", good(1))
    tags.put("d.a", good(1))  # the same sample: no change
    tags.put_bad(["d.a"], Reason.TIMEOUT)
    tags.put_bad(["d.a"], Reason.TIMEOUT)
    tags.amend("d.a", good(2))
    assert seen == [(who, value) for value in (1, 1, 2) for who in ("first", "second")]


def test_the_end_of_one_subscription_leaves_the_others_even_of_the_same_function() -> None:
    tags, seen = table(), list[object]()

    def put(name: str, value: TagValue) -> None:
        seen.append(value.value)

    unsubscribe = tags.subscribe(put)
    tags.subscribe(put)
    unsubscribe()
    unsubscribe()  # the second call does nothing
    tags.put("d.a", good(1))
    assert seen == [1]


def test_a_subscriber_may_unsubscribe_while_it_is_called() -> None:
    tags, seen = table(), list[object]()

    def once(name: str, value: TagValue) -> None:
        seen.append(("once", value.value))
        unsubscribe()

    unsubscribe = tags.subscribe(once)
    tags.subscribe(lambda name, value: seen.append(("always", value.value)))
    tags.put("d.a", good(1))
    tags.put("d.a", good(2))
    assert seen == [("once", 1), ("always", 1), ("always", 2)]


def test_a_client_that_follows_tags_sees_changes_beside_another_subscriber() -> None:
    tags, seen = table(), list[object]()
    tags.subscribe(lambda name, value: seen.append(value.value))
    watch = TagWatch(tags, Clock())
    tags.put("d.a", good(1))
    assert watch.answer({})["changes"] == []  # nothing is recorded before the first question
    tags.put("d.a", good(2))
    tags.put("d.a", good(3))
    assert [change[3] for change in watch.answer({})["changes"]] == [2, 3]
    assert seen == [1, 2, 3]
