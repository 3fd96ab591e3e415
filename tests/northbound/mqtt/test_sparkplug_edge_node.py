"""The messages of an edge node without a broker: births, data, deaths, sequence, history, quality and commands."""

from __future__ import annotations

import json
from collections import Counter
from typing import Any

import pytest
from hall_publication import GOOD, edge_node, note, note_all, silent
from hypothesis import given
from hypothesis import strategies as st

from fieldtwin.gateway.core.errors import Desync
from fieldtwin.gateway.core.values import Quality, Reason
from fieldtwin.northbound.mqtt.publication import Batch, WriteRequest
from fieldtwin.northbound.mqtt.sparkplug import AWAY, SparkplugPublication
from fieldtwin.northbound.mqtt.sparkplug_metrics import quality_code
from fieldtwin.northbound.samples import Sample
from fieldtwin.twin.thread.sparkplug_payloads import Metric, MetricType, Payload, decode_payload, encode_payload

NCMD, DCMD = "spBv1.0/plant/NCMD/hall", "spBv1.0/plant/DCMD/hall/fan"


def drained(node: SparkplugPublication, now_ms: int = 5000) -> list[tuple[str, Payload]]:
    """Publish all that waits: the kind of each message, with the device, and its payload."""
    found: list[tuple[str, Payload]] = []
    while (batch := node.next_batch(now_ms)) is not None:
        found += opened(batch)
        node.sent(batch)
    return found


def opened(batch: Batch) -> list[tuple[str, Payload]]:
    return [
        (m.topic.removeprefix("spBv1.0/plant/").replace("/hall", ""), decode_payload(m.payload)) for m in batch.messages
    ]


def born(**options: Any) -> SparkplugPublication:
    """An edge node whose devices have answered and were born."""
    node = edge_node(**options)
    note_all(node, 2000)
    node.begin(0, 3000)
    drained(node)
    return node


def kinds(found: list[tuple[str, Payload]]) -> list[str]:
    return [kind for kind, _ in found]


def test_a_session_begins_with_the_births_of_the_node_and_of_each_device_that_answers() -> None:
    node = edge_node()
    note(node, 2000, **{name: value for name, value in GOOD.items() if not name.startswith("fan")})
    node.begin(3, 3000)
    found = drained(node)
    assert kinds(found) == ["NBIRTH", "DBIRTH/sensor"], "a device that was never read is not born"
    assert [payload.seq for _, payload in found] == [0, 1]
    birth = {m.name: m for m in found[0][1].metrics}
    assert birth["bdSeq"].value == 3
    assert (birth["Node Control/Rebirth"].datatype, birth["Node Control/Rebirth"].alias) == (MetricType.BOOLEAN, None)
    assert birth["control/total"].value == 12
    sensor = {m.name: m for m in found[1][1].metrics}
    assert {name: m.value for name, m in sensor.items()} == {
        "temperature": 20.5, "offset": -5, "ticks": 4_000_000_000, "serial": "SN-1",
    }  # fmt: skip
    assert dict(sensor["temperature"].properties) == {
        "Quality": 192,
        "engUnit": "degC",
        "engLow": -20.0,
        "engHigh": 60.0,
    }
    assert all(m.t_ms == 2000 for m in sensor.values())
    note_all(node, 4000)
    assert kinds(drained(node)) == ["DBIRTH/fan"]


def test_an_unchanged_value_is_not_published_again() -> None:
    node = born()
    note_all(node, 6000)
    assert drained(node) == []
    note(node, 7000, fan__mode=0)
    [(kind, payload)] = drained(node)
    assert kind == "DDATA/fan"
    assert [(m.name, m.datatype, m.value, m.t_ms, m.historical) for m in payload.metrics] == [("", 0, 0, 7000, False)]


def test_variables_of_programs_are_data_of_the_node() -> None:
    node = born()
    note(node, 7000, control__total=13)
    [(kind, payload)] = drained(node)
    assert (kind, payload.metrics[0].value) == ("NDATA", 13)


def test_a_bad_value_is_null_and_has_a_quality_and_a_reason() -> None:
    node = born()
    note(node, 7000, sensor__temperature=Reason.SENTINEL)
    [(kind, payload)] = drained(node)
    assert kind == "DDATA/sensor"
    [metric] = payload.metrics
    assert metric.value is None
    assert dict(metric.properties) == {"Quality": 0, "Reason": "bad: sentinel"}


@given(st.sampled_from(Quality), st.sampled_from(Reason))
def test_only_a_good_value_has_the_quality_good(quality: Quality, reason: Reason) -> None:
    code = quality_code(quality, reason)
    assert code in (0, 192, 500)
    assert (code == 192) == (quality is Quality.GOOD)


def test_a_value_that_its_type_cannot_hold_is_bad() -> None:
    node = born()
    note(node, 7000, fan__mode=70_000)
    [(_, payload)] = drained(node)
    assert payload.metrics[0].value is None
    assert dict(payload.metrics[0].properties)["Reason"] == "bad: out of range"


@pytest.mark.parametrize("reason", sorted(AWAY))
def test_a_device_that_does_not_answer_dies_and_is_born_again_with_its_history(reason: Reason) -> None:
    node = born()
    silent(node, "fan", 6000, reason)
    [(kind, payload)] = drained(node)
    assert (kind, payload.metrics) == ("DDEATH/fan", ())
    note(node, 6500, sensor__offset=4)
    assert kinds(drained(node)) == ["DDATA/sensor"]
    note(node, 8000, fan__mode=7, fan__lamp=True)
    (birth, payload), (data, late) = drained(node)
    assert (birth, data) == ("DBIRTH/fan", "DDATA/fan")
    assert {m.name: m.value for m in payload.metrics} == {"mode": 7, "lamp": 1}
    assert [(m.value, m.t_ms, m.historical) for m in late.metrics] == [(None, 6000, True), (None, 6000, True)]


def test_a_device_that_answers_with_an_exception_stays_alive() -> None:
    node = born()
    silent(node, "fan", 6000, Reason.REFUSED)
    assert kinds(drained(node)) == ["DDATA/fan"]


def test_samples_of_the_time_without_a_session_are_historical_and_none_is_sent_twice() -> None:
    node = born()
    for n in range(5):
        note(node, 6000 + n, sensor__offset=n)
    node.begin(1, 9000)
    found = drained(node)
    assert kinds(found) == ["NBIRTH", "DBIRTH/sensor", "DBIRTH/fan", "DDATA/sensor"]
    assert {m.name: m.value for m in found[1][1].metrics}["offset"] == 4
    assert [(m.value, m.t_ms, m.historical) for m in found[3][1].metrics] == [(n, 6000 + n, True) for n in range(4)]
    assert node.backlog.waiting == 0


def test_a_batch_that_was_not_confirmed_is_published_again() -> None:
    node = born()
    note(node, 6000, sensor__offset=1)
    assert node.next_batch(6000) is not None  # the connection is lost before the broker has confirmed it
    note(node, 6100, sensor__offset=2)
    node.begin(1, 9000)
    [late] = [payload for kind, payload in drained(node) if kind == "DDATA/sensor"]
    assert [(m.value, m.t_ms, m.historical) for m in late.metrics] == [(1, 6000, True)]


def test_a_rebirth_repeats_all_births_with_the_same_bdseq() -> None:
    node = edge_node()
    note_all(node, 2000)
    node.begin(7, 3000)
    drained(node)
    note(node, 4000, sensor__offset=1)
    command = Payload(5000, (Metric("Node Control/Rebirth", None, 5000, MetricType.BOOLEAN, 1),))
    assert node.receive(NCMD, encode_payload(command)) == []
    found = drained(node)
    assert kinds(found) == ["NBIRTH", "DBIRTH/sensor", "DBIRTH/fan"]
    assert found[0][1].metrics[0].value == 7
    assert [payload.seq for _, payload in found] == [0, 1, 2]


def test_the_sequence_counts_from_0_to_255_over_all_messages() -> None:
    node = born()
    for n in range(600):
        note(node, 6000 + n, sensor__offset=n, control__total=n)
        drained(node)
    note(node, 9000, fan__mode=1)
    [(_, payload)] = drained(node)
    assert payload.seq == (3 + 2 * 600) % 256


def test_a_full_backlog_drops_the_oldest_samples_and_a_birth_follows() -> None:
    node = born(limit=100)
    for n in range(150):
        note(node, 6000 + n, sensor__offset=n)
    assert (node.backlog.waiting, node.backlog.dropped) == (100, 50)
    found = drained(node)
    assert [m.value for m in found[0][1].metrics] == list(range(50, 150))
    assert kinds(found)[1:] == ["NBIRTH", "DBIRTH/sensor", "DBIRTH/fan"], "the host may have missed a change"


def test_a_node_waits_for_its_primary_host_and_ends_its_session_when_the_host_goes_offline() -> None:
    node = edge_node(host="scada")
    state = "spBv1.0/STATE/scada"
    assert state in node.subscriptions
    note_all(node, 2000)
    node.begin(0, 3000)
    assert not node.is_ready

    def say(online: bool, t_ms: int) -> tuple[bool, bool]:
        node.receive(state, json.dumps({"online": online, "timestamp": t_ms}).encode())
        return node.is_ready, node.must_end

    assert say(False, 10) == (False, False)
    assert say(True, 20) == (True, False)
    drained(node)
    assert say(False, 19) == (True, False), "a state of an earlier session of the host is ignored"
    assert say(False, 20) == (False, True)
    node.begin(1, 4000)
    assert (node.is_ready, node.must_end) == (False, False)
    for text in (b"", b"OFFLINE", b"[]", b'{"online": true}', b'{"online": 1, "timestamp": 99}', b"\xff"):
        node.receive(state, text)
        assert not node.is_ready


def request(node: SparkplugPublication, *metrics: Metric, topic: str = DCMD) -> list[WriteRequest]:
    return node.receive(topic, encode_payload(Payload(1, metrics)))


def test_commands_are_refused_unless_the_server_accepts_them() -> None:
    [refused] = request(born(), Metric("mode", None, 1, MetricType.UINT16, 2))
    assert refused == WriteRequest("fan.mode", None, "the server does not accept commands (`writes: true`)")
    node = born(writes=True)
    alias = list(node.tags).index("fan.mode") + 1
    assert request(node, Metric("mode", None, 1, MetricType.UINT16, 2)) == [WriteRequest("fan.mode", 2.0)]
    assert request(node, Metric("", alias, 1, 0, 2)) == [WriteRequest("fan.mode", 2.0)]
    assert request(node, Metric("offset", None, 1, 0, (1 << 32) - 5), topic="spBv1.0/plant/DCMD/hall/sensor") == [
        WriteRequest("sensor.offset", -5.0)
    ]
    unknown = [WriteRequest("unknown", None, "the command names no tag of a device")]
    assert request(node, Metric("temperature", None, 1, 0, 2)) == unknown, "a tag of a different device"
    assert request(node, Metric("control/total", None, 1, 0, 2), topic=NCMD) == unknown
    assert request(node, Metric("mode", None, 1, MetricType.STRING, "on"))[0].refusal == "only numbers can be written"


@given(st.binary(max_size=200), st.sampled_from([NCMD, DCMD]))
def test_no_bytes_from_the_broker_break_the_node(data: bytes, topic: str) -> None:
    node = edge_node(writes=True)
    try:
        node.receive(topic, data)
    except Desync:
        pass


VALUES = st.tuples(
    st.sampled_from(["sensor.offset", "fan.mode", "control.total"]), st.integers(0, 3) | st.sampled_from(Reason)
)


@given(st.lists(st.lists(VALUES, max_size=4) | st.sampled_from(["drain", "session", "rebirth"]), max_size=30))
def test_a_host_that_follows_all_messages_has_the_latest_sample_of_every_tag_and_every_change_once(
    steps: list[Any],
) -> None:
    node = edge_node()
    node.begin(0, 0)
    known: dict[str, tuple[Any, int]] = {}
    names = dict(enumerate(node.tags, 1))
    received: list[tuple[str, Any, int]] = []
    changes: list[tuple[str, Any, int]] = []
    in_data: Counter[tuple[str, Any, int]] = Counter()

    def drain() -> None:
        for kind, payload in drained(node):
            if kind == "NBIRTH":
                known.clear()
            if kind.startswith("DDEATH"):
                for name in [n for n in known if n.startswith(kind.partition("/")[2])]:
                    del known[name]
            for m in payload.metrics:
                if m.alias is not None:
                    name = names[m.alias]
                    received.append((name, m.value, m.t_ms))
                    in_data[received[-1]] += "DATA" in kind
                    if not m.historical:
                        known[name] = (m.value, m.t_ms)

    for t_ms, step in enumerate(steps, 2000):
        if step == "drain":
            drain()
        elif step == "session":
            node.begin(1, t_ms)
        elif step == "rebirth":
            node.receive(
                NCMD, encode_payload(Payload(1, (Metric("Node Control/Rebirth", None, 1, MetricType.BOOLEAN, 1),)))
            )
        else:
            for name, value in dict(step).items():
                before = node.latest[name]
                note(node, t_ms, **{name: value})
                after = node.latest[name]
                if (before.value, before.quality, before.reason) != (after.value, after.quality, after.reason):
                    changes.append((name, after.value, t_ms))
    drain()
    for name, (value, t_ms) in known.items():
        latest = node.latest[name]
        assert value == latest.value
        assert t_ms <= latest.t_ms
    for change in changes:
        away = node.tags[change[0]].device
        if not away or any(name.startswith(away) for name in known):
            assert change in received, f"{change} was lost"
    assert all(count <= 1 for count in in_data.values())


def test_a_simulated_value_is_published_but_not_as_good() -> None:
    node = born()
    node.note("sensor.offset", Sample(9, Quality.SIMULATED, Reason.NONE, 0), 6000)
    [(_, payload)] = drained(node)
    assert payload.metrics[0].value == 9
    assert dict(payload.metrics[0].properties) == {"Quality": 500, "Reason": "simulated: none"}
