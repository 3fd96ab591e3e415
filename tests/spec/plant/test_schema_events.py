"""Schemas EventHandler, Producer, Consumer."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldtwin.gateway.core.concurrency.events import Consumer, EventHandler, Producer
from fieldtwin.gateway.core.errors import Bug
from fieldtwin.gateway.core.values import DATA

ITEMS = st.lists(st.builds(DATA, st.binary(max_size=3)), max_size=12)


def test_EventHandler_is_abstract() -> None:
    with pytest.raises(Bug, match="abstract"):
        EventHandler("response")


@pytest.mark.parametrize("kind", [Producer, Consumer])
def test_EventHandler_is_registered_for_exactly_one_event(kind: type[EventHandler]) -> None:
    assert issubclass(kind, EventHandler)
    assert kind("response").event == "response"


def test_EventHandler_of_another_event_is_refused() -> None:
    producer: Producer[DATA] = Producer("response")
    with pytest.raises(Bug, match="another event"):
        producer.subscribe(Consumer("command"))


@given(items=ITEMS, consumers=st.integers(0, 4))
def test_Producer_Emit_passes_exactly_what_occurred_to_every_Consumer(items: list[DATA], consumers: int) -> None:
    producer: Producer[DATA] = Producer("response")
    subscribers: list[Consumer[DATA]] = [Consumer("response") for _ in range(consumers)]
    deaf: Consumer[DATA] = Consumer("response")
    for subscriber in subscribers:
        producer.subscribe(subscriber)
    for item in items:
        producer.emit(item)
    for subscriber in subscribers:
        assert len(subscriber.queue) == len(items)
        assert all(heard is item for heard, item in zip(subscriber.queue, items, strict=True))
    assert not deaf.queue


def test_Consumer_queue_is_empty_after_Init_and_Consume_needs_an_element() -> None:
    consumer: Consumer[DATA] = Consumer("response")
    assert not consumer.queue
    with pytest.raises(Bug, match="empty"):
        consumer.consume()


@given(before=ITEMS, item=st.builds(DATA, st.binary(max_size=3)))
def test_Consumer_Observe_adds(before: list[DATA], item: DATA) -> None:
    consumer: Consumer[DATA] = Consumer("response")
    for old in before:
        consumer.observe(old)
    consumer.observe(item)
    assert list(consumer.queue) == [*before, item]


@given(items=ITEMS.filter(len))
def test_Consumer_Consume_takes_the_first_element(items: list[DATA]) -> None:
    consumer: Consumer[DATA] = Consumer("response")
    for item in items:
        consumer.observe(item)
    assert consumer.consume() is items[0]
    assert list(consumer.queue) == items[1:]


@given(items=ITEMS, capacity=st.integers(1, 8))
def test_Consumer_queue_is_a_bounded_FIFO_and_counts_what_it_drops(items: list[DATA], capacity: int) -> None:
    """Ruling 2: order is kept, duplicates survive, overflow drops the oldest and is counted."""
    consumer: Consumer[DATA] = Consumer("response", capacity)
    for item in items:
        consumer.observe(item)
    assert list(consumer.queue) == items[-capacity:]
    assert consumer.dropped == max(0, len(items) - capacity)
