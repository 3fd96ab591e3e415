"""Modbus bytes of a trace as text and exchanges: every framing, any division into chunks, any error."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from report_rig import CTD_VALUES, MS, READ_CTD, adu, answer, ask, chunk, observatory

from fieldtwin.capture.decoding.decoder import Decoder, exchanges
from fieldtwin.capture.decoding.exchange import DecodedExchange, TouchedSpan
from fieldtwin.capture.decoding.modbus_connection import KnownUnit, ModbusConnectionDecoder
from fieldtwin.capture.decoding.modbus_frames import splitter
from fieldtwin.capture.decoding.modbus_pdu import parse_request
from fieldtwin.capture.decoding.tags import TagMap
from fieldtwin.gateway.core.files.profile_file import load_profile
from fieldtwin.gateway.protocols.modbus.frames.ascii import lrc
from fieldtwin.gateway.protocols.modbus.frames.crc import with_crc
from fieldtwin.results.trace import TraceEvent

METER = Path(__file__).parents[3] / "profiles" / "devices" / "eastron-sdm630.yaml"


def only(events: list[TraceEvent]) -> DecodedExchange:
    (found,) = exchanges(observatory(), events)
    return found


def texts(events: list[TraceEvent]) -> list[str]:
    decoder = Decoder(observatory())
    return [decoder.decode(e).text for e in events]


def test_a_read_as_text_and_values() -> None:
    events = [ask(10, READ_CTD), answer(25, CTD_VALUES)]
    assert texts(events) == [
        "ctd: read input registers 30001 (input:0) x 10",
        "ctd: pressure 12.5 dbar, temperature 4.25 degC, conductivity 3.5 S/m, sample_count 7, instrument_time 70000 ms, "
        f"sample {CTD_VALUES[2:].hex()}",
    ]
    found = only(events)
    assert (found.t_ns, found.end_ns, found.latency_ns) == (10 * MS, 25 * MS, 15 * MS)
    assert (found.bus, found.device, found.unit, found.function) == ("line1", "ctd", 1, 4)
    assert found.spans == (TouchedSpan("read", "input", 0, 10),)
    assert (found.access, found.address, found.count, found.ok) == ("read", 0, 10, True)
    assert found.registers[6:] == (0, 7, 1, 4464)
    assert found.tags["temperature"] == 4.25
    assert found.reads("pressure")
    assert not found.reads("status")
    assert not found.writes()


def test_a_write_has_the_values_it_wrote() -> None:
    found = only([ask(0, "10 0001 0001 02 FFFF"), answer(9, "10 0001 0001")])
    assert found.tags == {"sample_period_s": -1}
    assert (found.access, found.registers, found.reply_text, found.ok) == ("write", (0xFFFF,), "done", True)
    assert found.text == "ctd: write registers 40002 (holding:1): sample_period_s -1 s"


def test_values_use_the_texts_of_the_profile() -> None:
    assert texts([ask(0, "03 0000 0001"), answer(5, "03 02 0001")])[1] == "ctd: status 1 (sampling)"


def test_an_exception_has_its_name() -> None:
    found = only([ask(0, "03 0000 0001"), answer(5, "83 06")])
    assert (found.exception, found.problem, found.reply_text) == (6, "exception", "exception 06 server device busy")
    assert found.tags == {"status": None}  # requested, not reported


def test_no_answer_ends_with_the_next_request_or_the_trace() -> None:
    decoder = Decoder(observatory())
    assert decoder.feed(ask(0, "03 0000 0001")) == []
    (first,) = decoder.feed(ask(300, "03 0001 0001"))
    (second,) = decoder.finish()
    assert [(e.t_ns, e.problem, e.latency_ns, list(e.tags)) for e in (first, second)] == [
        (0, "no reply", None, ["status"]),
        (300 * MS, "no reply", None, ["sample_period_s"]),
    ]


def test_a_broadcast_wants_no_answer() -> None:
    found = only([ask(0, "06 0001 0005", unit=0), ask(200, "03 0000 0001"), answer(205, "03 02 0000")][:1])
    assert (found.unit, found.ok, found.latency_ns) == (0, True, None)


def test_a_damaged_reply() -> None:
    raw = bytearray(with_crc(b"\x01" + CTD_VALUES))
    raw[7] ^= 4
    found = only([ask(0, READ_CTD), chunk(20, False, bytes(raw))])
    assert (found.problem, found.reply_text) == ("check sum", "damaged: the check sum is wrong")
    assert found.reply == bytes(raw)
    assert found.tags["pressure"] is None


def test_noise_and_the_frame_of_another_are_stepped_over() -> None:
    stranger = with_crc(bytes.fromhex("07 03 02 1234"))
    events = [ask(0, "03 0000 0001"), chunk(5, False, b"\x00\xff" + stranger), answer(9, "03 02 0002")]
    found = exchanges(observatory(), events)
    assert [(e.unit, e.problem) for e in found] == [(1, ""), (7, "stray")]
    assert found[0].tags == {"status": 2}
    assert found[0].latency_ns == 9 * MS


def test_a_reply_that_comes_twice_is_a_stray() -> None:
    found = exchanges(observatory(), [ask(0, "03 0000 0001"), answer(5, "03 02 0002"), answer(6, "03 02 0002")])
    assert [e.problem for e in found] == ["", "stray"]


def test_a_reply_to_a_different_request_is_malformed() -> None:
    found = only([ask(0, "06 0001 0005"), answer(5, "06 0001 0006")])
    assert found.problem == "malformed"
    assert "does not acknowledge the request" in found.reply_text


def test_tcp_replies_are_matched_by_their_transaction() -> None:
    first, second = adu(1, "03 0022 0001"), adu(2, "03 0022 0001")
    late = adu(1, "03 02 0009") + adu(2, "03 02 0008")
    events = [chunk(0, True, first, "lan"), chunk(50, True, second, "lan"), chunk(60, False, late, "lan")]
    found = exchanges(observatory(), events)
    assert [(e.t_ns // MS, e.tags, e.latency_ns) for e in found] == [
        (0, {"inbox_ack": "0009"}, 60 * MS),
        (50, {"inbox_ack": "0008"}, 10 * MS),
    ]
    assert found[0].device == "modem"


def test_a_mailbox_shows_its_payload() -> None:
    payload = bytes.fromhex("0003 0002 0005")
    found = only(
        [chunk(0, True, adu(1, "03 0000 0003"), "lan"), chunk(3, False, adu(1, "03 06" + payload.hex()), "lan")]
    )
    assert found.tags == {"inbox": "0005"}


def test_a_header_that_cannot_be_right_is_noise() -> None:
    decoded = Decoder(observatory()).decode(chunk(0, False, "0001 0000 FFFF 01 03", "lan"))
    assert decoded.text == "8 bytes of noise (an impossible header)"


def test_an_echo_is_not_a_reply() -> None:
    wire = ModbusConnectionDecoder(
        "line1", "rtu", {1: KnownUnit("ctd", TagMap(observatory().devices["ctd"].profile))}, echo=True
    )
    asked = with_crc(bytes.fromhex("01 06 0001 0005"))  # a write's reply looks like its echo
    assert wire.feed(True, asked, 0)[1] == []
    assert wire.feed(False, asked[:5], 1) == (["echo"], [])
    said, done = wire.feed(False, asked[5:] + asked, 2)
    assert said == ["echo", "ctd: done"]
    assert done[0].ok


def test_a_served_wire_is_requested_by_the_remote_side() -> None:
    wire = ModbusConnectionDecoder("hmi", "mbap", {}, served=True)
    request = adu(5, "04 0000 0002", unit=255)
    assert wire.feed(False, request[:4], 0) == (["4 bytes of a request"], [])
    assert wire.feed(False, request[4:], 1)[0] == ["unit 255: read input registers 30001 (input:0) x 2"]
    (done,) = wire.feed(True, adu(5, "04 04 4148 0000", unit=255), 3)[1]
    assert (done.registers, done.latency_ns, done.device) == ((0x4148, 0), 2, "")


def test_ascii_frames_are_decoded() -> None:
    def frame(body: str) -> bytes:
        raw = bytes.fromhex(body)
        return b":" + (raw + bytes([lrc(raw)])).hex().upper().encode() + b"\r\n"

    wire = ModbusConnectionDecoder("line1", "ascii", {})
    wire.feed(True, frame("01 03 0000 0001"), 0)
    said, done = wire.feed(False, b"xx:0103" + frame("01 03 02 00FF"), 7)
    assert done[0].registers == (255,)
    assert said[-1] == "unit 1: 00FF"
    wire.feed(True, frame("01 03 0000 0001"), 10)
    assert wire.feed(False, frame("01 03 02 00FF").replace(b"FF", b"FE", 1), 12)[1][0].problem == "check sum"


@pytest.mark.parametrize(
    ("pdu", "spans"),
    [
        ("01 0003 000A", [TouchedSpan("read", "coil", 3, 10)]),
        ("02 0003 000A", [TouchedSpan("read", "discrete", 3, 10)]),
        ("05 0007 FF00", [TouchedSpan("write", "coil", 7)]),
        ("0F 0007 0003 01 05", [TouchedSpan("write", "coil", 7, 3)]),
        ("16 0004 00F2 0025", [TouchedSpan("write", "holding", 4)]),
        ("17 0003 0006 000E 0001 02 00FF", [TouchedSpan("read", "holding", 3, 6), TouchedSpan("write", "holding", 14)]),
        ("14 07 06 0004 0001 0002", [TouchedSpan("read", "file", 1, 2, 4)]),
        ("15 09 06 0004 0007 0001 06AF", [TouchedSpan("write", "file", 7, 1, 4)]),
        ("08 0000 A537", []),
        ("2B 0E 01 00", []),
    ],
)
def test_the_addresses_of_requests(pdu: str, spans: list[TouchedSpan]) -> None:
    asked = parse_request(bytes.fromhex(pdu))
    assert (list(asked.spans), asked.problem) == (spans, "")


def test_written_bits_are_decoded_in_address_order() -> None:
    wire = ModbusConnectionDecoder("line1", "rtu", {})
    wire.feed(True, with_crc(bytes.fromhex("01 0F 0007 000A 02 CD01")), 0)
    (done,) = wire.feed(False, with_crc(bytes.fromhex("01 0F 0007 000A")), 1)[1]
    assert done.registers == (1, 0, 1, 1, 0, 0, 1, 1, 1, 0)


@pytest.mark.parametrize("pdu", ["03 0000", "10 0001 0002 02 0001", "17 0003", "05 00"])
def test_a_truncated_request_is_malformed(pdu: str) -> None:
    assert parse_request(bytes.fromhex(pdu)).problem == "malformed"


CONVERSATION = [
    ask(0, READ_CTD), answer(10, CTD_VALUES), ask(20, "03 0000 0002"), answer(30, "03 04 0001 0005"),
    ask(40, "10 0001 0001 02 0005"), answer(50, "90 06"), ask(60, "03 0064 0004"), answer(70, "03 08 3030343200000000"),
]  # fmt: skip


@given(st.data())
@settings(max_examples=25)
def test_chunk_borders_mean_nothing(data: st.DataObject) -> None:
    """However replies are divided, the exchanges are the same except for the time of their last byte."""
    cut: list[TraceEvent] = []
    for event in CONVERSATION:
        raw = bytes.fromhex(event.data["bytes"])
        if event.data["dir"] == "sent":
            cut.append(event)
            continue
        at = sorted({0, len(raw), *data.draw(st.lists(st.integers(0, len(raw)), max_size=4))})
        cut += [chunk(event.t_ns / MS + i, False, raw[a:b]) for i, (a, b) in enumerate(pairwise(at))]
    assert [(e.service, e.tags, e.problem, e.reply) for e in exchanges(observatory(), cut)] == [
        (e.service, e.tags, e.problem, e.reply) for e in exchanges(observatory(), CONVERSATION)
    ]


@given(
    st.sampled_from(["rtu", "ascii", "mbap"]), st.lists(st.tuples(st.booleans(), st.binary(max_size=40)), max_size=12)
)
@settings(max_examples=60)
def test_any_bytes_are_described_completely(framing: str, chunks: list[tuple[bool, bytes]]) -> None:
    wire = ModbusConnectionDecoder(
        "line1", framing, {1: KnownUnit("ctd", TagMap(observatory().devices["ctd"].profile))}
    )
    for t_ns, (sent, data) in enumerate(chunks):
        said, _ = wire.feed(sent, data, t_ns)
        assert all(said)
    wire.finish()
    one = splitter(framing)
    frames = [f for t_ns, (_, data) in enumerate(chunks) for f in one.feed(data, t_ns)]
    assert b"".join(f.raw for f in frames + one.flush()) == b"".join(data for _, data in chunks)
    assert [f.t_ns for f in frames] == sorted(f.t_ns for f in frames)


def test_on_tcp_an_answer_ends_earlier_requests() -> None:
    """One request at a time: the next answer shows that the first request was given up, and its own comes too late."""
    events = [chunk(0, True, adu(1, "03 0022 0001"), "lan"), chunk(50, True, adu(2, "03 0022 0001"), "lan")]
    decoder = Decoder(observatory())
    assert [decoder.feed(e) for e in events] == [[], []]
    first, second = decoder.feed(chunk(60, False, adu(2, "03 02 0008"), "lan"))
    assert (first.t_ns, first.problem) == (0, "no reply")
    assert (second.t_ns, second.ok) == (50 * MS, True)
    late = decoder.decode(chunk(70, False, adu(1, "03 02 0009"), "lan"))
    assert late.text == "modem: a late reply: transaction 1, unit 1, 00 01 00 00 00 05 01 03 02 00 09"
    assert [e.problem for e in late.exchanges] == ["stray"]
    assert decoder.finish() == []


@pytest.mark.parametrize("cut", [3, 8, 10])
def test_a_connection_that_is_lost_inside_an_answer(cut: int) -> None:
    """The next connection begins with a new frame, whatever the last one still had to send."""
    answer_1, answer_2 = adu(1, "03 02 0009"), adu(1, "03 02 0008")
    found = exchanges(
        observatory(),
        [chunk(0, True, adu(1, "03 0022 0001"), "lan"), chunk(5, False, answer_1[:cut], "lan"),
         chunk(900, True, adu(1, "03 0022 0001"), "lan"), chunk(903, False, answer_2, "lan")],
    )  # fmt: skip
    assert [(e.problem, e.tags["inbox_ack"]) for e in found] == [("no reply", None), ("", "0008")]


def test_an_answer_in_pieces_over_the_next_request_is_whole() -> None:
    """No connection was lost: the rest of the first answer arrives after the second request."""
    raw = adu(1, "03 02 0009")
    found = exchanges(
        observatory(),
        [chunk(0, True, adu(1, "03 0022 0001"), "lan"), chunk(5, False, raw[:4], "lan"),
         chunk(6, True, adu(2, "03 0022 0001"), "lan"), chunk(7, False, raw[4:] + adu(2, "03 02 0008"), "lan")],
    )  # fmt: skip
    assert [e.tags["inbox_ack"] for e in found] == ["0009", "0008"]


def test_secrets_have_no_value_in_text() -> None:
    wire = ModbusConnectionDecoder("line1", "rtu", {1: KnownUnit("meter", TagMap(load_profile(METER)))})
    words = wire.feed(True, with_crc(bytes.fromhex("01 10 000E 0002 04 447A0000")), 0)[0]
    assert words == ["meter: write registers 40015 (holding:14) x 2: password (secret)"]
    wire.feed(True, with_crc(bytes.fromhex("01 03 000F 0001")), 1)
    texts, (half,) = wire.feed(False, with_crc(bytes.fromhex("01 03 02 1234")), 2)  # half of it
    assert texts == ["meter: (secret)"]
    wire.feed(True, with_crc(bytes.fromhex("01 10 000E 0002 04 447A0000")), 3)
    (written,) = wire.feed(False, with_crc(bytes.fromhex("01 10 000E 0002")), 4)[1]
    assert written.tags == {"password": 1000.0}  # a scenario can check it
    for exchange in (half, written):
        told = exchange.describe()
        assert (told["registers"], set(told["tags"].values()) <= {"(secret)"}) == ([], True)
