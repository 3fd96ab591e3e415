"""Sparkplug B: our payloads and those of an independent implementation, and threads as messages of an edge node and a host."""

from __future__ import annotations

import json
import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldtwin.gateway.core.errors import Desync, UsageError
from fieldtwin.gateway.core.values import Quality, Reason
from fieldtwin.gateway.store.event import Event, Kind, Value
from fieldtwin.twin.thread.frames import Ack, Ask, Data, Frame, Hello, Lost, Refused, Schema
from fieldtwin.twin.thread.mqtt.message import MqttMessage
from fieldtwin.twin.thread.sparkplug import HISTORICAL_MS, REBIRTH, EdgeNode, HostApplication
from fieldtwin.twin.thread.sparkplug_payloads import (
    Metric,
    MetricType,
    Payload,
    decode_payload,
    encode_payload,
    topic,
    type_of,
)

SCHEMA = Schema(("ctd.pressure", "ctd.serial", "relay"))
VALUES: st.SearchStrategy[Value] = (
    st.none()
    | st.integers(-(1 << 63), (1 << 63) - 1)
    | st.floats(allow_nan=False)
    | st.text(max_size=20)
    | st.binary(max_size=20)
)
PROPERTIES = st.lists(
    st.tuples(st.text(min_size=1, max_size=5), st.integers(0, 1 << 30)), max_size=2, unique_by=lambda p: p[0]
).map(tuple)
METRICS = st.builds(
    lambda name, alias, t, value, historical, properties: Metric(
        name, alias, t, 0 if value is None else type_of(value), value, historical, properties
    ),
    st.text(min_size=1, max_size=10), st.none() | st.integers(0, 1000), st.integers(0, 1 << 45), VALUES, st.booleans(),
    PROPERTIES,
)  # fmt: skip
EVENTS = st.builds(
    Event, st.just(0), st.integers(0, 1 << 42), st.integers(0, 6), st.sampled_from([*SCHEMA.names, "another.tag"]), VALUES,
    st.integers(0, 4), st.integers(0, 14),
)  # fmt: skip


@given(metrics=st.lists(METRICS, max_size=5), seq=st.none() | st.integers(0, 255))
def test_a_payload_comes_back_as_it_went(metrics: list[Metric], seq: int | None) -> None:
    payload = Payload(5, tuple(metrics), seq)
    back = decode_payload(encode_payload(payload))
    assert back == payload
    assert [type(m.value) for m in back.metrics] == [type(m.value) for m in metrics]


@given(data=st.binary(max_size=100))
def test_no_bytes_break_the_reader(data: bytes) -> None:
    for text in (data, b"\x12" + bytes([len(data)]) + data):
        try:
            decode_payload(text)
        except Desync:
            pass


@given(metrics=st.lists(METRICS, max_size=5), seq=st.integers(0, 255))
@settings(max_examples=40)
def test_another_implementation_reads_ours_and_we_read_its(metrics: list[Metric], seq: int) -> None:
    """pysparkplug contains the generated code of Eclipse Tahu's definition."""
    theirs = pytest.importorskip("pysparkplug._protobuf", reason="no pysparkplug here").Payload()
    theirs.ParseFromString(encode_payload(Payload(7, tuple(metrics), seq)))
    assert (theirs.timestamp, theirs.seq, len(theirs.metrics)) == (7, seq, len(metrics))
    for ours, other in zip(metrics, theirs.metrics, strict=True):
        assert (other.name, other.timestamp, other.is_historical) == (ours.name, ours.t_ms, ours.historical)
        assert list(other.properties.keys) == [name for name, _ in ours.properties]
        if ours.value is None:
            assert other.is_null
        elif isinstance(ours.value, int):
            assert other.long_value == ours.value & (1 << 64) - 1
        elif isinstance(ours.value, float):
            assert other.double_value == ours.value
        else:
            assert (other.bytes_value if isinstance(ours.value, bytes) else other.string_value) == ours.value
    assert decode_payload(theirs.SerializeToString()) == Payload(7, tuple(metrics), seq)


def test_foreign_numbers_are_read_with_their_sign() -> None:
    protobuf = pytest.importorskip("pysparkplug._protobuf", reason="no pysparkplug here")
    theirs = protobuf.Payload()
    for name, datatype, field, sent in (
        ("int8", 1, "int_value", (1 << 32) - 5), ("int32", 3, "int_value", (1 << 32) - 5),
        ("uint32", 7, "int_value", (1 << 32) - 5),
        ("int64", 4, "long_value", (1 << 64) - 5), ("float", 9, "float_value", 0.5), ("bool", 11, "boolean_value", True),
    ):  # fmt: skip
        metric = theirs.metrics.add(name=name, datatype=datatype)
        setattr(metric, field, sent)
    read = {m.name: m.value for m in decode_payload(theirs.SerializeToString()).metrics}
    assert read == {"int8": -5, "int32": -5, "uint32": (1 << 32) - 5, "int64": -5, "float": 0.5, "bool": 1}


@pytest.mark.parametrize("name", ["", "a/b", "#", "a+b", "a\n"])
def test_names_that_are_patterns_are_refused(name: str) -> None:
    with pytest.raises(UsageError):
        topic("plants", "NDATA", name)
    with pytest.raises(UsageError):
        topic(name, "NDATA", "x")


# -- threads ----------------------------------------------------------------------------------------------------------------

HELLO = Hello("plant:5f3a91c2", SCHEMA.id, 1, 9, True)


def sides() -> tuple[EdgeNode, HostApplication]:
    types = {"ctd.serial": MetricType.STRING, "relay": MetricType.INT64}
    return EdgeNode("plants", "observatory", "shore", SCHEMA, types, 3), HostApplication(
        "plants", "observatory", "shore"
    )


def over(messages: list[MqttMessage], to: EdgeNode | HostApplication) -> list[Frame]:
    frames = (to.frame(m.topic, m.payload) for m in messages if m.topic in to.subscriptions)
    return [frame for frame in frames if frame is not None]


@given(events=st.lists(EVENTS, min_size=1, max_size=20), first=st.integers(1, 1 << 40))
def test_logged_values_arrive_bit_by_bit_in_both_directions(events: list[Event], first: int) -> None:
    edge, host = sides()
    assert over(edge.messages(HELLO, 5), host) == [HELLO]
    data = Data(HELLO.tag, tuple(e._replace(sequence=n) for n, e in enumerate(events, first)))
    for one, other in ((edge, host), (host, edge)):
        (back,) = over(one.messages(data, 1 << 41), other)
        assert back == data
        assert isinstance(back, Data)
        assert [type(e.value) for e in back.events] == [type(e.value) for e in events]
        assert one.fit(data.events) == len(events)


@pytest.mark.parametrize(
    "frame", [Ack(HELLO.tag, 7, ((1, 2),)), Lost(HELLO.tag, 1, 5), Refused(HELLO.tag, b"abcd"), Ask(HELLO.tag)]
)
def test_messages_of_two_threads_arrive(frame: Frame) -> None:
    edge, host = sides()
    over(edge.messages(HELLO, 5), host)
    assert over(edge.messages(frame, 5), host) == [frame]
    assert over(host.messages(frame, 5), edge) == [frame]


def test_a_birth_announces_every_tag_with_its_type_and_restarts_the_count() -> None:
    edge, _ = sides()
    birth, data = edge.messages(HELLO, 5)[0], edge.messages(Ack(HELLO.tag, 1), 6)[0]
    payload = decode_payload(birth.payload)
    assert (birth.topic, payload.seq) == ("spBv1.0/plants/NBIRTH/observatory", 0)
    assert decode_payload(data.payload).seq == 1
    metrics = {m.name: m for m in payload.metrics}
    assert (metrics["bdSeq"].value, metrics[REBIRTH].value) == (3, 0)
    assert {n: metrics[n].datatype for n in SCHEMA.names} == {"ctd.pressure": 10, "ctd.serial": 12, "relay": 4}
    assert decode_payload(edge.messages(HELLO, 5)[0].payload).seq == 0


def test_data_has_aliases_times_quality_and_marks_historical_values() -> None:
    edge, host = sides()
    over(edge.messages(HELLO, 5), host)
    now = 1_790_000_000_000
    events = (
        Event(1, now - 50, Kind.VALUE, "ctd.pressure", 1.5),
        Event(2, now - HISTORICAL_MS - 1, Kind.VALUE, "ctd.pressure", None, int(Quality.BAD), int(Reason.TIMEOUT)),
    )
    (message,) = edge.messages(Data(HELLO.tag, events), now)
    fresh, old = decode_payload(message.payload).metrics[2:]
    assert (fresh.name, fresh.alias, fresh.datatype, fresh.value, fresh.historical) == ("", 1, 0, 1.5, False)
    assert (old.value, old.historical, dict(old.properties)["Quality"]) == (None, True, 0)
    assert fresh.properties == ()


def test_a_host_that_missed_the_birth_requests_it() -> None:
    edge, host = sides()
    edge.messages(HELLO, 5)
    data = Data(HELLO.tag, (Event(1, 5, 0, "ctd.pressure", 1.5),))
    frames = over(edge.messages(data, 5), host)
    assert frames == []
    assert host.not_taken == 1
    rebirth = host.hello()[1]
    assert over([rebirth], edge) == [Ask(HELLO.tag)]
    assert decode_payload(rebirth.payload).metrics[0].name == REBIRTH


def test_a_host_that_comes_online_is_informed_at_once() -> None:
    edge, host = sides()
    assert over(host.hello()[:1], edge) == [], "nothing was born yet"
    edge.messages(HELLO, 5)
    assert over(host.hello()[:1], edge) == [Ask(HELLO.tag)]
    assert over([host.will()], edge) == []
    for said in (b'{ "timestamp": 5, "online" : true }', b"ONLINE", b"\xff", b"[]", b'{"online": 1}'):
        assert bool(over([MqttMessage("spBv1.0/STATE/shore", said)], edge)) is said.startswith(b"{ ")


def test_birth_and_death_of_a_host_have_the_time_of_its_session() -> None:
    host = HostApplication("plants", "observatory", "shore", 1_790_000_000_123)
    (birth, rebirth), death = host.hello(), host.will()
    assert json.loads(birth.payload) == {"online": True, "timestamp": 1_790_000_000_123}
    assert json.loads(death.payload) == {"online": False, "timestamp": 1_790_000_000_123}
    assert (birth.qos, birth.retain, death.qos, death.retain) == (1, True, 1, True)
    assert decode_payload(rebirth.payload).t_ms == 1_790_000_000_123


def test_deaths_of_this_session_count_and_those_of_an_earlier_one_do_not() -> None:
    edge, host = sides()
    over(edge.messages(HELLO, 5), host)
    earlier = EdgeNode("plants", "observatory", "shore", SCHEMA, {}, 2)
    over([earlier.will()], host)
    assert host.alive
    over([edge.will()], host)
    assert not host.alive


def test_missing_messages_are_counted() -> None:
    edge, host = sides()
    over(edge.messages(HELLO, 5), host)
    sent = [edge.messages(Ack(HELLO.tag, n), 5)[0] for n in range(300)]
    over(sent[:100] + sent[101:], host)
    assert host.missed == 1


def test_third_party_commands_are_not_taken() -> None:
    edge, _ = sides()
    edge.messages(HELLO, 5)
    write = encode_payload(Payload(5, (Metric("ctd.sample_period_s", None, 5, MetricType.INT64, 1),)))
    assert edge.frame("spBv1.0/plants/NCMD/observatory", write) is None
    assert edge.not_taken == 1


def test_over_a_broker_a_shadow_sends_only_acknowledgements_and_rebirths() -> None:
    _, host = sides()
    for frame in (Ack(HELLO.tag, 7), Ask(HELLO.tag), Refused(HELLO.tag, b"abcd")):
        for message in host.messages(frame, 5):
            assert message.topic == "spBv1.0/plants/NCMD/observatory"
            names = {m.name for m in decode_payload(message.payload).metrics}
            assert names in ({"fieldtwin/frame"}, {REBIRTH})


def test_infinity_and_minus_zero_stay() -> None:
    edge, host = sides()
    over(edge.messages(HELLO, 5), host)
    events = (Event(1, 5, 0, "ctd.pressure", math.inf), Event(2, 5, 0, "ctd.pressure", -0.0))
    (back,) = over(edge.messages(Data(HELLO.tag, events), 5), host)
    assert isinstance(back, Data)
    assert [math.copysign(1, e.value) for e in back.events if isinstance(e.value, float)] == [1, -1]
