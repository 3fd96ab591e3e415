"""Messages in JSON: topics, contents, intervals and history."""

from __future__ import annotations

import json
from typing import Any

from hall_publication import GOOD, json_messages, note, note_all

from fieldtwin.gateway.core.values import Quality, Reason
from fieldtwin.northbound.mqtt.backlog import Entry
from fieldtwin.northbound.mqtt.json_topics import JsonPublication, contents
from fieldtwin.northbound.mqtt.served_tags import ServedTag
from fieldtwin.twin.site.servers.serving_mqtt import JsonConfig

CONFIG = JsonConfig("plant/{system}/{device}/{tag}", "plant/{system}/status")


def drained(publication: JsonPublication) -> list[tuple[str, Any]]:
    found: list[tuple[str, Any]] = []
    while (batch := publication.next_batch(5000)) is not None:
        for message in batch.messages:
            is_status = message.topic.endswith("/status")
            found.append((message.topic, message.payload if is_status else json.loads(message.payload)))
        publication.sent(batch)
    return found


def started(config: JsonConfig = CONFIG) -> JsonPublication:
    publication = json_messages(config)
    note_all(publication, 2000)
    publication.begin(0, 3000)
    drained(publication)
    return publication


def test_a_session_begins_with_the_status_and_the_latest_value_of_every_tag() -> None:
    publication = json_messages(CONFIG)
    note_all(publication, 2000)
    will = publication.begin(0, 3000)
    assert (will.topic, will.payload, will.qos, will.retain) == ("plant/hall/status", b"offline", 1, True)
    status, *values = drained(publication)
    assert status == ("plant/hall/status", b"online")
    assert dict(values)["plant/hall/sensor/temperature"] == {
        "value": 20.5, "quality": "good", "unit": "degC", "time": "1970-01-01T00:00:02.000Z",
    }  # fmt: skip
    assert dict(values)["plant/hall/fan/mode"]["text"] == "FAULT"
    assert dict(values)["plant/hall/fan/lamp"]["value"] is True
    assert dict(values)["plant/hall/control/total"]["value"] == 12
    assert len(values) == len(GOOD)


def test_changes_are_published_and_a_bad_value_is_null() -> None:
    publication = started()
    note_all(publication, 6000)
    assert drained(publication) == []
    note(publication, 7000, sensor__temperature=Reason.TIMEOUT)
    [(topic, message)] = drained(publication)
    assert topic == "plant/hall/sensor/temperature"
    assert message == {
        "value": None, "quality": "bad", "reason": "timeout", "unit": "degC", "time": "1970-01-01T00:00:07.000Z",
    }  # fmt: skip


def test_with_an_interval_every_tag_is_published_at_each_look() -> None:
    publication = started(JsonConfig(CONFIG.topic, CONFIG.status, interval=True))
    for _ in range(2):
        publication.end_look()
        assert len(drained(publication)) == len(GOOD)


def test_changes_of_the_time_without_a_connection_are_published_only_with_history() -> None:
    for history in (False, True):
        publication = started(JsonConfig(CONFIG.topic, CONFIG.status, history=history))
        for n in range(3):
            note(publication, 6000 + n, sensor__offset=n)
        publication.begin(1, 9000)
        found = [message for topic, message in drained(publication) if topic.endswith("/offset")]
        assert [m["value"] for m in found] == ([0, 1, 2, 2] if history else [2])
        assert [m.get("historical", False) for m in found] == ([True] * 3 + [False] if history else [False])


def test_a_number_that_json_does_not_know_is_bad() -> None:
    tag = ServedTag("a", "a", "x", "a.x", "Double")
    for value in (float("nan"), float("inf")):
        found = contents(Entry(tag, value, Quality.GOOD, Reason.NONE, 1))
        assert (found["value"], found["quality"], found["reason"]) == (None, "bad", "not a number")
    raw = contents(Entry(ServedTag("a", "a", "x", "a.x", "ByteString"), b"\x01\xff", Quality.GOOD, Reason.NONE, 1))
    assert raw["value"] == "01ff"
