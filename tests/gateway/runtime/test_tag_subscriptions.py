"""Subscriptions to the tag table: several subscribers, their order, their end, and what is reported to them."""

from __future__ import annotations

import msgspec

from fieldtwin.gateway.core.values import Quality, Reason, TagValue
from fieldtwin.gateway.runtime.tags import TagTable
from fieldtwin.twin.plant.watching import AT_ONCE, MOST_CHANGES, TagWatch


class Clock:
    """A clock that stands still."""

    def monotonic_ns(self) -> int:
        return 5

    def utc_ns(self) -> int:
        return 5

    async def sleep_until_ns(self, t_ns: int) -> None:
        raise AssertionError("nothing sleeps here")


def good(number: int) -> TagValue:
    return TagValue(number, Quality.GOOD, Reason.NONE, number, number.to_bytes(4))


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


def test_a_client_that_connects_late_gets_the_changes_since_the_start_but_no_repeated_samples() -> None:
    tags, seen = table(), list[object]()
    tags.subscribe(lambda name, value: seen.append(value.value))
    watch = TagWatch(tags, Clock())
    tags.put("d.a", good(1))
    tags.put("d.a", msgspec.structs.replace(good(1), t_ns=9))  # a later sample with the same value
    tags.put_bad(["d.a"], Reason.TIMEOUT)
    tags.put("d.a", good(2))
    answer = watch.answer({"since": 0})
    assert [change[3:] for change in answer["changes"]] == [
        (1, "good", "none"),
        (1, "bad", "timeout"),
        (2, "good", "none"),
    ]
    assert (answer["began_ns"], answer["last"], answer["dropped"]) == (5, 3, 0)
    assert seen == [1, 1, 1, 2]


def test_a_client_that_asks_without_a_number_gets_only_later_changes() -> None:
    tags = table()
    watch = TagWatch(tags, Clock())
    tags.put("d.a", good(1))
    first = watch.answer({})
    assert (first["changes"], first["dropped"]) == ([], 0)
    tags.put("d.a", good(2))
    assert [change[3] for change in watch.answer({"since": first["last"]})["changes"]] == [2]


def test_samples_are_kept_from_the_first_request_on_with_repeated_values() -> None:
    tags = table()
    watch = TagWatch(tags, Clock())
    tags.put("d.a", good(1))
    first = watch.answer({"samples": True})
    for t_ns in (7, 8):
        tags.put("d.a", msgspec.structs.replace(good(1), t_ns=t_ns))
    answer = watch.answer({"samples": True, "since": first["last"]})
    assert [sample[0] for sample in answer["changes"]] == [1, 2]


def test_the_oldest_changes_are_dropped_and_counted_and_an_answer_has_a_limited_number() -> None:
    tags = table()
    watch = TagWatch(tags, Clock())
    for number in range(1, MOST_CHANGES + 4):
        tags.put("d.a", good(number))
    first = watch.answer({"since": 0})
    assert first["dropped"] == 3
    assert [c[0] for c in first["changes"]] == list(range(4, AT_ONCE + 4))
    assert [c[3] for c in first["changes"]] == [c[0] for c in first["changes"]]
    assert [c[0] for c in watch.answer({"since": MOST_CHANGES + 1})["changes"]] == [MOST_CHANGES + 2, MOST_CHANGES + 3]
