"""The comparison itself, on constructed conversations: the differences it accepts and those it reports."""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any

import pytest
import yaml
from compare import TOLERANCES, DeviceRules, compare, load_tolerances
from conversation import Conversation, Exchange, Heard, canopen_conversation, crc16, rtu_conversation, tcp_conversation
from pydantic import ValidationError

from fieldtwin.gateway.connections.tap import Captured
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.connection import Direction
from fieldtwin.gateway.core.endpoint import Endpoint

LINE = Endpoint.parse("rtu:/dev/ttyS0")
S, R = Direction.SENT, Direction.RECEIVED


def rules(**more: Any) -> DeviceRules:
    return DeviceRules(latency_within_ms=10, latency_why="test", **more)


def talk(*exchanges: tuple[str, str], heard: tuple[tuple[int, str], ...] = (), latency_ms: float = 5.0) -> Conversation:
    """Requests and replies in hex, one every tenth of a second."""
    return Conversation(
        "device",
        [
            Exchange(100_000_000 * i, bytes.fromhex(a), bytes.fromhex(b), latency_ms)
            for i, (a, b) in enumerate(exchanges)
        ],
        [Heard(100_000_000 * i, cob_id, bytes.fromhex(data)) for i, (cob_id, data) in enumerate(heard)],
    )


def found(a: Conversation, b: Conversation, r: DeviceRules) -> list[str]:
    return [f"{d.what}: {d.expected} / {d.got}" for d in compare(a, b, r)]


READ, WRITE = ("01 03 0000 0001", "01 03 02 0007"), ("01 06 0001 0005", "01 06 0001 0005")
POLL = {"request": "01 03 0000", "why": "test"}


def test_the_script_is_compared_in_order_and_to_the_byte() -> None:
    assert found(talk(READ, WRITE), talk(READ, WRITE), rules()) == []
    assert found(talk(READ, WRITE), talk(WRITE, READ), rules()) == [
        "request bytes: 01 03 00 00 00 01 / 01 06 00 01 00 05"
    ]
    assert found(talk(READ, WRITE), talk(READ), rules()) == ["number of requests: 2 / 1"]
    assert found(talk(READ), talk((READ[0], "01 03 02 0008")), rules()) == ["bytes: 01 03 02 00 07 / 01 03 02 00 08"]


@pytest.mark.parametrize(
    ("reply", "what"),
    [
        ("01 83 02", "refusal: none / exception 02h"),
        ("01 03 02 0007 00", "length: 5 bytes / 6 bytes"),
        ("", "reply: 01 03 02 00 07 / none"),
        ("02 03 02 0007", "address and function: 01 03 / 02 03"),
    ],
)
@pytest.mark.parametrize("polled", [False, True])
def test_no_rule_excuses_the_structure_of_a_reply(reply: str, what: str, polled: bool) -> None:
    anything = {"name": "value", "at": 3, "format": ">H", "within": 65535, "why": "test"}
    r = rules(polls=[{**POLL, "fields": [anything], "spare": {"most": 5, "why": "test"}}] if polled else [])
    assert what in found(talk(READ), talk((READ[0], reply)), r)


def test_another_code_is_found() -> None:
    assert found(talk((READ[0], "01 83 02")), talk((READ[0], "01 83 03")), rules()) == [
        "refusal: exception 02h / exception 03h"
    ]
    upload = "0605 40 0020 00 00000000"
    a, b = (talk((upload, f"0585 80 0020 00 {code}")) for code in ("00000206", "11000906"))
    assert found(a, b, rules()) == ["refusal: abort 06020000h / abort 06090011h"]


def test_polls_may_repeat_and_fall_anywhere() -> None:
    r = rules(polls=[POLL])
    assert found(talk(READ, READ, WRITE, READ), talk(WRITE, READ), r) == []
    assert found(talk(WRITE), talk(WRITE, READ), r) == ["poll: never sent / 01 03 00 00 00 01"]
    assert found(talk(WRITE, READ), talk(WRITE, ("01 03 0000 0002", "01 03 04 0007 0007")), r) == [
        "poll: 01 03 00 00 00 01 / 01 03 00 00 00 02"
    ]


def test_the_values_of_a_poll_count_and_not_their_number() -> None:
    old, new = (READ[0], "01 03 02 0001"), (READ[0], "01 03 02 0002")
    r = rules(polls=[POLL])
    assert found(talk(old, old, new), talk(old, new, new), r) == []
    assert found(talk(old, new), talk(old, old), r) == ["bytes: 01 03 02 00 02 / 01 03 02 00 01"]
    spare = rules(polls=[{**POLL, "spare": {"most": 1, "why": "test"}}])
    assert found(talk(old, new), talk(old, old), spare) == []
    assert found(talk(new, old), talk(old, old), spare) != []  # only the last one may be missing
    assert found(talk(old, new), talk(old, (READ[0], "01 03 02 0003")), spare) != []  # and not if it differs


def test_swapped_words_are_a_different_value() -> None:
    at = {"name": "pressure", "at": 3, "format": ">f", "within": 0.5, "why": "test"}
    r = rules(polls=[{**POLL, "fields": [at]}])

    def read(data: bytes) -> Conversation:
        return talk(("01 03 0000 0002", "01 03 04" + data.hex()))

    ten, near, far = (struct.pack(">f", v) for v in (10.0, 10.5, 10.75))
    assert found(read(ten), read(near), r) == []
    assert found(read(ten), read(far), r) == ["pressure: 10 +- 0.5 / 10.75"]
    assert found(read(near), read(near[2:] + near[:2]), r)[0].startswith("pressure: 10.5 +- 0.5 / ")


def test_streams_are_ordered_separately() -> None:
    one, two, three = (("01 06 0009 " + v, "01 06 0009 " + v) for v in ("0001", "0002", "0003"))
    r = rules(streams=[{"request": "01 06 0009", "why": "test", "spare": {"most": 1, "why": "test"}}])
    assert found(talk(one, WRITE, two), talk(WRITE, one, two, three), r) == []
    assert found(talk(one, two), talk(two, one), r) == ["request bytes: 01 06 00 09 00 01 / 01 06 00 09 00 02"]
    assert found(talk(one, two, three), talk(one), r) == ["number of requests: 3 / 1"]


def test_received_frames_are_a_series_or_states() -> None:
    field = {"name": "slope", "at": 0, "format": "<h", "within": 5, "why": "test"}
    r = rules(
        heard=[
            {"cob_id": "185", "why": "test", "fields": [field]},
            {"cob_id": "705", "why": "test", "collapse": True},
        ]
    )
    states = ((0x705, "7F"), (0x705, "05"), (0x705, "05"))
    assert found(talk(heard=((0x185, "0100"), *states)), talk(heard=((0x185, "0600"), *states[:2])), r) == []
    assert found(talk(heard=((0x185, "0100"),)), talk(heard=((0x185, "0700"),)), r) == ["slope: 1 +- 5 / 7"]
    assert found(talk(heard=((0x185, "0100"),)), talk(heard=((0x185, "0100 00"),)), r) == ["length: 2 bytes / 3 bytes"]
    assert found(talk(heard=states), talk(heard=states[1:]), r)[0] == "states: 7f 05 / 05"
    assert found(talk(heard=states), talk(heard=(*states, (0x085, "00"))), r) == [
        "frames: 0 / 1 (no rule says what they are)"
    ]


def test_latency_and_interval_have_limits() -> None:
    assert found(talk(READ), talk(READ, latency_ms=15.0), rules()) == []
    assert found(talk(READ), talk(READ, latency_ms=15.2), rules()) == ["median latency in ms: 5.0 +- 10 / 15.2"]
    r = rules(polls=[{**POLL, "interval_within_ms": 50}])
    assert found(talk(READ, READ), talk(READ, WRITE, READ), r)[0] == "median interval in ms: 100.0 +- 50 / 200.0"


def captured(*items: tuple[Direction, bytes | CanFrame]) -> list[Captured]:
    return [Captured(1_000_000 * i, LINE, direction, item) for i, (direction, item) in enumerate(items)]


def framed(pdu: str) -> bytes:
    data = bytes.fromhex(pdu)
    return data + crc16(data).to_bytes(2, "little")


def test_an_rtu_capture_becomes_exchanges_however_it_was_cut() -> None:
    reply = framed(READ[1])
    read = captured((S, framed(READ[0])), (R, reply[:3]), (R, reply[3:]), (S, framed(WRITE[0])))
    a, b = rtu_conversation("ctd", read).exchanges
    assert (a.request.hex(), a.reply.hex(), a.latency_ms) == ("010300000001", "0103020007", 2.0)
    assert (b.request.hex(), b.reply) == ("010600010005", b"")


@pytest.mark.parametrize(
    ("read", "items", "fault"),
    [
        (rtu_conversation, [(S, framed(READ[0])), (R, framed(READ[1])[:-1] + b"\0")], "reply with a bad CRC"),
        (tcp_conversation, [(S, bytes.fromhex("0001 0000 0007 010300000001"))], "request with a bad MBAP header"),
        (
            tcp_conversation,
            [
                (S, bytes.fromhex("0001 0000 0006 010300000001")),
                (R, bytes.fromhex("0002 0000 0005 0103020007")),
            ],
            "transaction 0001 answered as 0002",
        ),
        (
            lambda d, c: canopen_conversation(d, c, 5),
            [(R, CanFrame(0x585, bytes(8)))],
            "an SDO reply that nobody asked for",
        ),
    ],
)
def test_an_invalid_frame_is_a_fault_and_a_difference(
    read: Callable[[str, list[Captured]], Conversation], items: list[tuple[Direction, bytes | CanFrame]], fault: str
) -> None:
    faulty = read("device", captured(*items))
    assert [f for f in faulty.faults if f.startswith(fault)]
    assert [d for d in compare(faulty, faulty, rules()) if fault in d.got]


def test_the_tolerances_name_a_reason_for_everything() -> None:
    text = yaml.safe_load(TOLERANCES.read_text(encoding="utf-8"))
    for device in load_tolerances(text).values():
        assert len(device.latency_why) > 10
        for rule in (*device.polls, *device.streams):
            assert len(rule.why) > 10
            assert not rule.spare.most or len(rule.spare.why) > 10
        for field in [f for r in (*device.polls, *device.streams, *device.heard) for f in r.fields]:
            assert field.why
    with pytest.raises(ValidationError):
        load_tolerances({"ctd": {**text["ctd"], "excuse": True}})
