"""The effect of each fault on a frame, byte by byte: on a line, in ASCII, with an MBAP header; on CAN frames; on
numbers."""

from __future__ import annotations

import math
import re
from pathlib import Path
from random import Random
from typing import Any

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from fieldtwin.emulators.faults.can_fault import BusFault, CanFault
from fieldtwin.emulators.faults.engine import WireFaults
from fieldtwin.emulators.faults.fault import (
    Active,
    Aim,
    ConnectionEffect,
    DelayedBytes,
    FaultEffect,
    ValueFault,
    WireFault,
    passed,
)
from fieldtwin.emulators.faults.frames import Assembler, FaultFrame, FrameDirection, Framing, understood
from fieldtwin.emulators.faults.registry import FAULTS
from fieldtwin.emulators.faults.schema import parse_fault
from fieldtwin.gateway.core.canframe import CanFrame


def crc(data: bytes) -> bytes:
    """CRC-16 of Modbus (polynomial 0xA001 reflected, start 0xFFFF), low byte first."""
    value = 0xFFFF
    for byte in data:
        value ^= byte
        for _ in range(8):
            value = (value >> 1) ^ (0xA001 if value & 1 else 0)
    return value.to_bytes(2, "little")


def line(adu: str) -> bytes:
    """An RTU frame."""
    data = bytes.fromhex(adu)
    return data + crc(data)


def ascii_(adu: str) -> bytes:
    data = bytes.fromhex(adu)
    return b":" + data.hex().upper().encode() + f"{-sum(data) & 0xFF:02X}".encode() + b"\r\n"


REPLY = "1103 04 000A 0102"
ON_LINE, IN_ASCII, ON_TCP = line(REPLY), ascii_(REPLY), bytes.fromhex("0007 0000 0007" + REPLY)


def made(name: str, **said: Any) -> Any:
    return parse_fault({"name": name, **said}).make()


def struck(name: str, data: bytes, framing: Framing = Framing.RTU, /, **said: Any) -> FaultEffect:
    fault = made(name, **said)
    assert isinstance(fault, WireFault)
    frame = understood(FrameDirection.REPLY, framing, data)
    assert frame.pdu, "the frame of a test is a whole one"
    return fault.apply(frame, Random(7))


def pieces(outcome: FaultEffect) -> list[tuple[bytes, float]]:
    return [(piece.data, piece.delay_s) for piece in outcome.pieces]


@pytest.mark.parametrize(
    ("name", "said", "expected"),
    [
        ("drop", {}, []),
        ("silence", {}, []),
        ("disconnect", {}, []),
        ("delay", {"by_ms": 70}, [(ON_LINE, 0.07)]),
        ("late-reply", {"by_ms": 400}, [(ON_LINE, 0.4)]),
        ("coalesce", {"every_ms": 20}, [(ON_LINE, 0.02)]),
        ("duplicate", {"times": 2, "after_ms": 5}, [(ON_LINE, 0.0), (ON_LINE, 0.005), (ON_LINE, 0.005)]),
        ("reorder", {"most_ms": 90}, [(ON_LINE, 0.09)]),
        ("split", {"at": 3, "pause_ms": 1}, [(ON_LINE[:3], 0.0), (ON_LINE[3:], 0.001)]),
        ("pause", {"pause_ms": 40}, [(ON_LINE[:4], 0.0), (ON_LINE[4:], 0.04)]),
        ("corrupt-crc", {}, [(ON_LINE[:-1] + bytes((ON_LINE[-1] ^ 0x5A,)), 0.0)]),
        ("corrupt-length", {"by": 2}, [(line("1103 06 000A 0102"), 0.0)]),
        ("wrong-unit", {"unit_id": 9}, [(line("0903 04 000A 0102"), 0.0)]),
        ("wrong-function", {"code": 4}, [(line("1104 04 000A 0102"), 0.0)]),
        ("wrong-transaction", {}, [(ON_LINE, 0.0)]),
        ("fewer-registers", {}, [(line("1103 02 000A"), 0.0)]),
        ("fewer-registers", {"by": 9}, [(line("1103 02 000A"), 0.0)]),
        ("truncate", {"count": 2}, [(ON_LINE[:-2], 0.0)]),
        (
            "split",
            {"at": 4, "times": 9, "pause_ms": 2},
            [(ON_LINE[:4], 0.0), (ON_LINE[4:8], 0.002), (ON_LINE[8:], 0.004)],
        ),
        ("noise", {"data": "00 FF"}, [(b"\0\xff" + ON_LINE, 0.0)]),
        ("garbage", {"data": "0000"}, [(ON_LINE + b"\0\0", 0.0)]),
        ("exception", {"code": 4}, [(line("1183 04"), 0.0)]),
        ("busy", {}, [(line("1183 06"), 0.0)]),
        ("wrong-parity", {}, [(bytes(b for b in ON_LINE if b.bit_count() % 2 == 0), 0.0)]),
    ],
)
def test_on_a_line(name: str, said: dict[str, Any], expected: list[tuple[bytes, float]]) -> None:
    assert pieces(struck(name, ON_LINE, **said)) == expected


@pytest.mark.parametrize(
    ("name", "said", "expected"),
    [
        ("corrupt-length", {"by": -1}, "0007 0000 0006" + REPLY),
        ("wrong-transaction", {"by": 3}, "000A 0000 0007" + REPLY),
        ("wrong-transaction", {"to": 0}, "0000 0000 0007" + REPLY),
        ("wrong-transaction", {"by": 0, "protocol": 1}, "0007 0001 0007" + REPLY),
        ("corrupt-length", {"by": -7}, "0007 0000 0000" + REPLY),
        ("corrupt-length", {"by": -8}, "0007 0000 FFFF" + REPLY),
        ("wrong-unit", {"unit_id": 9}, "0007 0000 0007 0903 04 000A 0102"),
        ("wrong-function", {"code": 4}, "0007 0000 0007 1104 04 000A 0102"),
        ("fewer-registers", {}, "0007 0000 0005 1103 02 000A"),
        ("exception", {"code": 2}, "0007 0000 0003 1183 02"),
        ("busy", {}, "0007 0000 0003 1183 06"),
        ("corrupt-crc", {}, "0007 0000 0007" + REPLY),
    ],
)
def test_faults_after_an_mbap_header(name: str, said: dict[str, Any], expected: str) -> None:
    assert pieces(struck(name, ON_TCP, Framing.MBAP, **said)) == [(bytes.fromhex(expected), 0.0)]


@pytest.mark.parametrize(
    ("name", "said", "expected"),
    [
        ("wrong-unit", {"unit_id": 9}, ascii_("0903 04 000A 0102")),
        ("exception", {"code": 2}, ascii_("1183 02")),
    ],
)
def test_effect_of_each_fault_on_an_ascii_frame(name: str, said: dict[str, Any], expected: bytes) -> None:
    assert pieces(struck(name, IN_ASCII, Framing.ASCII, **said)) == [(expected, 0.0)]


def test_the_check_sum_of_ascii() -> None:
    ((spoilt, _),) = pieces(struck("corrupt-crc", IN_ASCII, Framing.ASCII))
    assert spoilt != IN_ASCII
    assert (spoilt[:-4], spoilt[-2:]) == (IN_ASCII[:-4], b"\r\n")


def test_random_choices_of_faults() -> None:
    ((spoilt, _),) = pieces(struck("corrupt-bits", ON_LINE, bits=3))
    assert sum((a ^ b).bit_count() for a, b in zip(spoilt, ON_LINE, strict=True)) == 3
    ((fits, _),) = pieces(struck("corrupt-bits", ON_LINE, fits=True))
    assert (fits[:2], crc(fits), fits != ON_LINE) == (ON_LINE[:2], b"\0\0", True)
    ((behind, _),) = pieces(struck("garbage", ON_LINE, count=5))
    assert behind[:-5] == ON_LINE
    before, frame = pieces(struck("noise", ON_LINE, count=5, lead_ms=2))
    assert (len(before[0]), frame) == (5, (ON_LINE, 0.002))
    ((_, late_s),) = pieces(struck("jitter", ON_LINE, most_ms=20))
    assert 0 <= late_s <= 0.02
    ((talked_over, _),) = pieces(struck("collision", ON_LINE, at=2))
    assert talked_over[:2] == ON_LINE[:2]
    assert talked_over != ON_LINE
    assert all(a & b == a for a, b in zip(talked_over, ON_LINE, strict=True))
    assert len(pieces(struck("wrong-baud", ON_LINE, factor=2.0))[0][0]) == 2 * len(ON_LINE)
    assert pieces(struck("wrong-baud", ON_LINE, factor=0.01)) == []


def test_an_echo_goes_back_first() -> None:
    assert struck("echo", ON_LINE).pieces == (DelayedBytes(ON_LINE, back=True), DelayedBytes(ON_LINE))


def test_faults_of_a_connection() -> None:
    assert struck("reset", ON_TCP, Framing.MBAP, at=4) == FaultEffect(
        (DelayedBytes(ON_TCP[:4]),), ConnectionEffect.RESET
    )
    assert struck("half-open", ON_TCP, Framing.MBAP) == FaultEffect(connection=ConnectionEffect.HALF_OPEN)
    assert made("disconnect").appears() is ConnectionEffect.CLOSE
    assert made("disconnect").refuses


def test_the_next_frame_goes_before_the_reordered() -> None:
    fault = made("reorder", most_ms=50)
    first, second = (understood(FrameDirection.REPLY, Framing.RTU, line(f"1103 02 000{n}")) for n in (1, 2))
    (held,) = fault.apply(first, Random(1)).pieces
    assert [piece.data for piece in fault.apply(second, Random(1)).pieces] == [second.data, first.data]
    assert held.gone is not None
    assert held.gone()  # the frames were swapped
    (alone,) = fault.apply(first, Random(1)).pieces
    assert alone.gone is not None
    assert not alone.gone()  # no second frame arrived


NODE = 5


@pytest.mark.parametrize(
    ("name", "said", "frame", "expected"),
    [
        ("lost-frame", {}, (0x185, "0102"), []),
        ("heartbeat-loss", {}, (0x705, "05"), []),
        ("heartbeat-loss", {}, (0x185, "05"), None),
        ("duplicate-node", {}, (0x705, "05"), [(0x705, "05", 0.0), (0x705, "7f", 0.001)]),
        ("sdo-abort", {"code": 0x06090011}, (0x585, "4b176000ff000000"), [(0x585, "8017600011000906", 0.0)]),
        ("sdo-abort", {}, (0x605, "4017600000000000"), None),
        ("sdo-toggle", {}, (0x585, "00616263"), [(0x585, "10616263", 0.0)]),
        ("sdo-toggle", {}, (0x585, "4b176000ff000000"), None),
        ("lost-segment", {}, (0x585, "00616263"), []),
        ("lost-segment", {}, (0x585, "4117600020000000"), None),
        ("emcy-burst", {}, (0x185, "01"), None),
        ("late-frame", {"by_ms": 50}, (0x185, "0102"), [(0x185, "0102", 0.05)]),
        ("short-frame", {"length": 1}, (0x185, "0102"), [(0x185, "01", 0.0)]),
        ("odd-heartbeat", {"state": 0x55}, (0x705, "05"), [(0x705, "55", 0.0)]),
        ("odd-heartbeat", {}, (0x585, "05"), None),
        ("odd-sdo", {"command": 0xE0}, (0x585, "4b106000ff000000"), [(0x585, "e0106000ff000000", 0.0)]),
        ("odd-sdo", {"index_by": 1}, (0x585, "4b106000ff000000"), [(0x585, "4b116000ff000000", 0.0)]),
        ("odd-sdo", {"index_by": 1}, (0x585, "0061626300000000"), [(0x585, "0061626300000000", 0.0)]),
        ("odd-sdo", {"size_by": 5}, (0x585, "4108100009000000"), [(0x585, "410810000e000000", 0.0)]),
        ("odd-sdo", {"no_size": True}, (0x585, "4b106000ff000000"), [(0x585, "42106000ff000000", 0.0)]),
        ("odd-sdo", {"no_size": True}, (0x585, "4108100009000000"), [(0x585, "4008100000000000", 0.0)]),
        (
            "odd-sdo",
            {"before": 1},
            (0x585, "4b106000ff000000"),
            [(0x585, "e000000000000000", 0.0), (0x585, "4b106000ff000000", 0.0)],
        ),
        ("odd-sdo", {}, (0x605, "4010600000000000"), None),
        ("boot-storm", {}, (0x705, "05"), None),
    ],
)
def test_on_a_can_bus(
    name: str, said: dict[str, Any], frame: tuple[int, str], expected: list[tuple[int, str, float]] | None
) -> None:
    """None: the fault does not apply to this."""
    fault = made(name, **said)
    assert isinstance(fault, CanFault)
    sent = CanFrame(frame[0], bytes.fromhex(frame[1]))
    assert fault.aims_at(sent, NODE) is (expected is not None)
    if expected is not None:
        after = [(p.frame.can_id, p.frame.data.hex(), p.delay_s) for p in fault.apply(sent, NODE, Random(1))]
        assert after == expected


def test_faults_of_unsolicited_frames_of_a_node() -> None:
    emcy = made("emcy-burst", count=3, code=0x8110, every_ms=2).appears(NODE, Random(1))
    assert [(p.frame.can_id, p.frame.data[:2], p.delay_s) for p in emcy] == [
        (0x85, b"\x10\x81", n * 0.002) for n in range(3)
    ]
    (short,) = made("emcy-burst", count=1, length=3).appears(NODE, Random(1))
    assert short.frame.data == b"\x00\x10\x01"
    (far,) = made("odd-sdo", extended=True).apply(CanFrame(0x585, bytes(8)), NODE, Random(1))
    assert far.frame.extended
    boots = made("boot-storm", count=3, every_ms=50).appears(NODE, Random(1))
    assert [(p.frame, p.delay_s) for p in boots] == [(CanFrame(0x705, b"\0"), n * 0.05) for n in range(3)]


def test_late_frames_on_a_can_bus() -> None:
    (beat,) = made("heartbeat-late", most_ms=300).apply(CanFrame(0x705, b"\5"), NODE, Random(1))
    assert 0 < beat.delay_s <= 0.3
    sync = made("sync-jitter", most_ms=5)
    assert sync.ways == frozenset((FrameDirection.REQUEST,))
    assert sync.aims_at(CanFrame(0x80, b""), NODE)
    (heard,) = sync.apply(CanFrame(0x80, b""), NODE, Random(1))
    assert 0 < heard.delay_s <= 0.005


def test_faults_of_the_wire_itself() -> None:
    assert (made("error-frame").attempts, made("bus-off").attempts) == (None, 32)
    assert isinstance(made("bus-off"), BusFault)


@pytest.mark.parametrize(
    ("name", "said", "expected"),
    [
        ("stuck", {}, 3.0),
        ("drift", {"per_s": 0.5}, 11.0),
        ("spike", {"by": -4, "probability_each": 1.0}, 6.0),
        ("spike", {"by": -4, "probability_each": 0.0}, 10.0),
        ("out-of-range", {"value": -1e6}, -1e6),
        ("set", {"value": 1.25}, 1.25),
    ],
)
def test_effect_of_each_fault_on_a_value(name: str, said: dict[str, Any], expected: float) -> None:
    fault = made(name, **said)
    assert isinstance(fault, ValueFault)
    assert fault.distort(10.0, 2.0, 3.0, Random(1)) == expected


def test_the_nan_fault_gives_nan() -> None:
    assert math.isnan(made("nan").distort(10.0, 2.0, 3.0, Random(1)))


# -- aim ------------------------------------------------------------------------------------------------------------------


def active(**aim: Any) -> Active:
    addresses = aim.pop("addresses", None)
    units, functions = aim.pop("units", ()), aim.pop("functions", frozenset())
    until_ns = aim.pop("until_ns", None)
    from_ns = aim.pop("from_ns", 0)
    fault = made("drop")
    return Active(
        "x",
        fault,
        Aim(**aim),
        Random("seed x"),
        from_ns,
        until_ns,
        units=units,
        addresses=addresses,
        functions=functions,
    )


REQUEST = understood(FrameDirection.REQUEST, Framing.RTU, line("1103 0010 0002"))


def hits(fault: Active, times: int = 8, frame: FaultFrame = REQUEST) -> list[int]:
    """Return which frames out of so many, one second apart, the fault changes; counted from 1."""
    return [n for n in range(1, times + 1) if fault.applies_to(frame, n * 1_000_000_000)]


@pytest.mark.parametrize(
    ("aim", "struck"),
    [
        ({}, [1, 2, 3, 4, 5, 6, 7, 8]),
        ({"nth": 3}, [3]),
        ({"every": 3}, [3, 6]),
        ({"from_ns": 3_000_000_000, "until_ns": 6_000_000_000}, [3, 4, 5]),
        ({"units": (0x11,)}, [1, 2, 3, 4, 5, 6, 7, 8]),
        ({"units": (0x12,)}, []),
        ({"function": 3, "nth": 1}, [1]),
        ({"function": 4}, []),
        ({"addresses": range(0x10, 0x11), "nth": 1}, [1]),
        ({"addresses": range(0x11, 0x20)}, []),
        ({"addresses": range(0x10, 0x11), "functions": frozenset({3, 6}), "nth": 1}, [1]),
        ({"addresses": range(0x10, 0x11), "functions": frozenset({4})}, []),
        ({"direction": "reply"}, []),
        ({"direction": "request", "nth": 1}, [1]),
        ({"direction": "both", "nth": 1}, [1]),
        ({"probability": 0.0}, []),
    ],
)
def test_faults_with_a_target(aim: dict[str, Any], struck: list[int]) -> None:
    assert hits(active(**aim)) == struck


def test_chance_is_the_seeds() -> None:
    first, second = hits(active(probability=0.5), 64), hits(active(probability=0.5), 64)
    assert first == second
    assert 16 < len(first) < 48


def test_faults_strike_one_after_the_other() -> None:
    faults = WireFaults(Framing.RTU)
    for name, said in (("wrong-unit", {"unit_id": 9}), ("delay", {"by_ms": 10}), ("truncate", {"count": 1})):
        fault = made(name, **said)
        faults.put_in(Active(name, fault, Aim(), Random(1), 0, 5))
    outcome = faults.decide(understood(FrameDirection.REPLY, Framing.RTU, ON_LINE), 1)
    assert outcome is not None
    assert pieces(outcome) == [(line("0903 04 000A 0102")[:-1], 0.01)]
    assert faults.decide(understood(FrameDirection.REPLY, Framing.RTU, ON_LINE), 5) is None
    assert not faults.active, "what is over is forgotten"


@pytest.mark.parametrize("divides", [kind for kind in FAULTS.values() if issubclass(kind, WireFault) and kind.divides])
def test_a_fault_that_divides_a_frame_acts_after_all_others(divides: type[WireFault]) -> None:
    """Otherwise the bytes of `garbage` would be inside the frame, and Modbus TCP has no checksum to detect them."""
    faults = WireFaults(Framing.MBAP)
    for fault in (divides(divides.form()), made("garbage", data="FFFF")):
        faults.put_in(Active(fault.name, fault, Aim(), Random(1), 0, 5))
    frame = understood(FrameDirection.REPLY, Framing.MBAP, bytes.fromhex("000700000007010304000A0102"))
    outcome = faults.decide(frame, 1)
    assert outcome is not None
    assert len(outcome.pieces) == 2
    assert b"".join(piece.data for piece in outcome.pieces) == frame.data + b"\xff\xff"


# -- frames ---------------------------------------------------------------------------------------------------------------

PDUS = st.binary(min_size=2, max_size=60)


@settings(max_examples=60, deadline=None)
@given(st.lists(PDUS, max_size=4), st.sampled_from([Framing.MBAP, Framing.ASCII]), st.randoms(use_true_random=False))
def test_frames_are_found_however_they_are_cut(pdus: list[bytes], framing: Framing, random: Random) -> None:
    frames = [
        ascii_("11" + pdu.hex()) if framing is Framing.ASCII else bytes(5) + bytes((len(pdu) + 1, 0x11)) + pdu
        for pdu in pdus
    ]
    stream = b"".join(frames)
    assembler, found = Assembler(FrameDirection.REPLY, framing), []
    while stream:
        n = random.randint(1, len(stream))
        found += assembler.feed(stream[:n])
        stream = stream[n:]
    assert [f.data for f in found] == frames
    assert [(f.unit, f.pdu) for f in found] == [(0x11, pdu) for pdu in pdus]
    assert assembler.flush() == []


def publish(payload: bytes, first: int = 0x30) -> bytes:
    """An MQTT packet (3.3): first byte, remaining length in groups of seven bits, topic "t", payload."""
    rest, length = len(payload) + 3, b""
    while rest or not length:
        length += bytes([rest & 0x7F | (0x80 if rest > 0x7F else 0)])
        rest >>= 7
    return bytes([first]) + length + b"\0\1t" + payload


@settings(max_examples=60, deadline=None)
@given(
    st.lists(
        st.binary(min_size=1, max_size=300) | st.integers(0, 255).map(lambda byte: bytes([byte]) * 16400), max_size=4
    ),
    st.sampled_from([Framing.THREAD, Framing.MQTT]),
    st.randoms(use_true_random=False),
)
def test_frames_of_a_stream_are_found_however_they_are_cut(
    payloads: list[bytes], framing: Framing, random: Random
) -> None:
    frames = [publish(p) if framing is Framing.MQTT else len(p).to_bytes(2) + p for p in payloads]
    stream = b"".join(frames)
    assembler, found = Assembler(FrameDirection.REPLY, framing), []
    while stream:
        n = random.randint(1, len(stream))
        found += assembler.feed(stream[:n])
        stream = stream[n:]
    assert [f.data for f in found] == frames


def test_only_mqtt_packets_without_delivery_guarantee_are_dropped() -> None:
    """PUBLISH with QoS 0. Other packets establish the session with the broker, and TCP delivers them."""
    faults = WireFaults(Framing.MQTT)
    faults.put_in(Active("drop", made("drop"), Aim(), Random(1), 0, None))

    def struck_first(first: int) -> bool:
        return faults.decide(understood(FrameDirection.REPLY, Framing.MQTT, publish(b"x", first)), 1) is not None

    assert [first for first in range(0x10, 0x100) if struck_first(first)] == [0x30, 0x31, 0x38, 0x39]


@settings(max_examples=60, deadline=None)
@given(st.lists(st.binary(max_size=700), max_size=5), st.sampled_from(Framing))
def test_no_byte_is_lost_or_made(chunks: list[bytes], framing: Framing) -> None:
    assembler = Assembler(FrameDirection.REQUEST, framing)
    frames = [f for chunk in chunks for f in assembler.feed(chunk)] + assembler.flush()
    assert b"".join(f.data for f in frames) == b"".join(chunks)


@settings(max_examples=60, deadline=None)
@example(b"", Framing.RTU, FAULTS["corrupt-crc"])
@given(
    st.binary(max_size=40),
    st.sampled_from(Framing),
    st.sampled_from([k for k in FAULTS.values() if issubclass(k, WireFault)]),
)
def test_every_fault_takes_every_frame(data: bytes, framing: Framing, kind: type[WireFault]) -> None:
    fault = kind(kind.form())
    for way in FrameDirection:
        outcome = fault.apply(understood(way, framing, data), Random(1))
        assert all(isinstance(piece.data, bytes) and piece.delay_s >= 0 for piece in outcome.pieces)


def test_every_fault_is_in_these_tables() -> None:
    assert set(FAULTS) <= set(re.findall(r'"([a-z-]+)"', Path(__file__).read_text()))


REQUESTS = ("1103 0000 0002", "1101 0000 0008", "1106 0000 0102", "1110 0000 0002 04 000A 0102")
REPLIES = (REPLY, "1101 01 5A", "1106 0000 0102", "1110 0000 0002", "1183 02")


def frames_of(framing: Framing) -> list[FaultFrame]:
    made_of = {
        Framing.RTU: line,
        Framing.ASCII: ascii_,
        Framing.MBAP: lambda adu: b"\0\7\0\0" + len(bytes.fromhex(adu)).to_bytes(2) + bytes.fromhex(adu),
    }.get(framing, lambda adu: b"\x30\x1f" + b"\x5a" * 31)
    ways = ((FrameDirection.REQUEST, REQUESTS), (FrameDirection.REPLY, REPLIES))
    return [understood(way, framing, made_of(adu)) for way, texts in ways for adu in texts]


@pytest.mark.parametrize("framing", Framing)
@pytest.mark.parametrize("name", [name for name, kind in FAULTS.items() if issubclass(kind, WireFault)])
def test_a_fault_declares_the_framings_in_which_it_changes_anything(name: str, framing: Framing) -> None:
    kind = FAULTS[name]
    assert issubclass(kind, WireFault)
    random = Random(3)
    struck = {f.function for f in frames_of(framing) if made(name).apply(f, random) != passed(f.data)}
    assert bool(struck) is (framing in kind.framings)
    assert not kind.functions or struck <= kind.functions
