"""Producer and Consumer: every event, to all consumers, in order, bounded (the paper's EventHandler, Producer and Consumer)."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldtwin.gateway.core.concurrency.events import Consumer, EventHandler, Producer
from fieldtwin.gateway.core.errors import Bug
from fieldtwin.gateway.core.values import COMMAND, DATA


def test_an_event_handler_is_abstract() -> None:
    with pytest.raises(Bug):
        EventHandler("response")


def test_a_new_consumer_is_empty_and_consuming_then_is_a_bug() -> None:
    consumer: Consumer[DATA] = Consumer("response")
    assert not consumer.queue
    with pytest.raises(Bug, match="empty queue"):
        consumer.consume()


@given(st.lists(st.binary(max_size=4)), st.integers(1, 8))
def test_every_consumer_gets_all_events_in_order_and_counts_its_losses(items: list[bytes], capacity: int) -> None:
    producer: Producer[DATA] = Producer("response")
    wide: Consumer[DATA] = Consumer("response", capacity=max(1, len(items)))
    narrow: Consumer[DATA] = Consumer("response", capacity=capacity)
    for consumer in (wide, narrow, wide):  # registering twice has no further effect
        producer.subscribe(consumer)
    occurred = [DATA(item) for item in items]
    for item in occurred:
        producer.emit(item)
    assert list(wide.drain()) == occurred  # duplicates survive
    assert wide.dropped == 0
    assert list(narrow.drain()) == occurred[-capacity:]
    assert narrow.dropped == max(0, len(items) - capacity)


def test_a_consumer_of_another_event_is_refused() -> None:
    producer: Producer[DATA] = Producer("response")
    with pytest.raises(Bug, match="another event"):
        producer.subscribe(Consumer("command"))


def test_the_very_object_is_passed_on() -> None:
    producer: Producer[COMMAND] = Producer("command")
    consumer: Consumer[COMMAND] = Consumer("command")
    producer.subscribe(consumer)
    command = COMMAND(b"\x00\x01")
    producer.emit(command)
    assert consumer.consume() is command


def test_items_that_arrive_while_draining_wait_for_the_next_drain() -> None:
    consumer: Consumer[DATA] = Consumer("response")
    consumer.observe(DATA(b"1"))
    seen = []
    for item in consumer.drain():
        seen.append(item)
        consumer.observe(DATA(b"again"))
    assert seen == [DATA(b"1")]
    assert list(consumer.queue) == [DATA(b"again")]
