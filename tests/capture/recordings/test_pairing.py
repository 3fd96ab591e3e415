"""Requests and replies of third parties become exchanges, even if they are cut, mixed and damaged."""

from __future__ import annotations

from hypothesis import given, settings
from hypothesis import strategies as st
from packets import crc, mbap, read, values

from fieldtwin.capture.recordings.pairing import Bad, HalfDuplexPairer, MbapPairer, Pairer, SerialPairer
from fieldtwin.gateway.core.files.recording import RecordedExchange

MS = 1_000_000


def run(wire: Pairer, *steps: tuple[bool, bytes]) -> list[RecordedExchange]:
    """Return the exchanges of chunks that are a millisecond apart."""
    found = [e for i, (sent, data) in enumerate(steps) for e in wire.feed(sent, data, i * MS)]
    return found + wire.finish()


def told(exchanges: list[RecordedExchange]) -> list[tuple[int, bytes, bytes | None, str | None]]:
    return [(e.unit, e.request, e.reply, e.error) for e in exchanges]


cuts = st.lists(st.integers(1, 20), max_size=8)


def pieces(data: bytes, sizes: list[int]) -> list[bytes]:
    out, at = [], 0
    for size in sizes:
        out.append(data[at : at + size])
        at += size
    return [p for p in [*out, data[at:]] if p]


@settings(max_examples=40)
@given(st.permutations(range(5)), cuts, cuts)
def test_pipelined_requests_are_paired_in_order_however_they_are_cut(
    order: list[int], one: list[int], two: list[int]
) -> None:
    requests = b"".join(mbap(7 + i, i, read(i)) for i in range(5))
    replies = b"".join(mbap(7 + i, i, values(i)) for i in order)
    chunks = [(True, p) for p in pieces(requests, one)] + [(False, p) for p in pieces(replies, two)]
    wire = MbapPairer(0)
    assert told(run(wire, *chunks)) == [(i, read(i), values(i), None) for i in range(5)]
    assert (wire.counters.exchanges, wire.counters.malformed, wire.counters.strays) == (5, 0, 0)


def test_missing_wrong_and_surplus_answers_are_reported() -> None:
    bad: list[Bad] = []
    wire = MbapPairer(0, bad.append)
    found = run(
        wire,
        (True, mbap(1, 1, read(0))),
        (True, mbap(2, 1, read(1))),
        (False, mbap(2, 1, b"\x83\x02")),
        (False, mbap(9, 1, values(5))),
        (True, mbap(3, 1, read(2))),
        (False, mbap(3, 4, values(5))),
        (False, b"\x00\x05\x00\x07\x00\x03\x01\x03\x00"),
        (True, mbap(4, 1, read(3))[:9]),
    )
    assert told(found) == [
        (1, read(0), None, "timeout"), (1, read(1), b"\x83\x02", None), (1, read(2), None, "desync"),
    ]  # fmt: skip
    assert found[1].latency_s == 0.001
    assert (wire.counters.strays, wire.counters.malformed, wire.counters.unanswered) == (2, 2, 2)
    assert [b.data for b in bad] == [
        values(5),
        values(5),
        b"\x00\x05\x00\x07\x00\x03\x01\x03\x00",
        mbap(4, 1, read(3))[:9],
    ]


def test_unanswered_requests_do_not_pile_up() -> None:
    wire = MbapPairer(0)
    found = [e for i in range(1000) for e in wire.feed(True, mbap(i, 1, read(i)), i)]
    assert len(found) == 1000 - 64
    assert [e.request for e in found + wire.finish()] == [read(i) for i in range(1000)]


@settings(max_examples=40)
@given(cuts)
def test_a_line_is_paired_however_it_is_cut(sizes: list[int]) -> None:
    chunks: list[tuple[bool, bytes]] = []
    for i in range(3):
        chunks += [(True, p) for p in pieces(crc(bytes((1 + i,)) + read(i)), sizes)]
        chunks += [(False, p) for p in pieces(crc(bytes((1 + i,)) + values(i)), sizes)]
    assert told(run(SerialPairer("rtu", 0), *chunks)) == [(1 + i, read(i), values(i), None) for i in range(3)]


def test_silence_noise_foreign_frames_and_broadcasts_on_a_line() -> None:
    broadcast = bytes.fromhex("06 0001 0005")
    wire = SerialPairer("rtu", 0)
    found = run(
        wire,
        (True, crc(b"\x01" + read(0))),
        (True, crc(b"\x01" + read(1))),
        (False, crc(b"\x01" + values(9))[:-1] + b"\xff"),
        (True, crc(b"\x00" + broadcast)),
        (True, crc(b"\x01" + read(2))),
        (False, crc(b"\x02" + values(9))),
        (False, crc(b"\x01" + values(8))),
    )
    assert told(found) == [
        (1, read(0), None, "timeout"), (1, read(1), None, "crc"), (0, broadcast, b"", None),
        (1, read(2), values(8), None),
    ]  # fmt: skip
    assert (wire.counters.strays, wire.counters.malformed) == (1, 1)


def test_ascii_and_half_duplex_in_both_directions() -> None:
    def ascii_frame(data: bytes) -> bytes:
        return b":" + (data + bytes((-sum(data) & 0xFF,))).hex().upper().encode() + b"\r\n"

    steps = ((True, ascii_frame(b"\x05" + read(1))), (False, ascii_frame(b"\x05" + values(2))))
    assert told(run(SerialPairer("ascii", 0), *steps)) == [(5, read(1), values(2), None)]
    write = bytes.fromhex("06 0001 0005")
    frames = [
        b"\x01" + read(0),
        b"\x01" + values(7),
        b"\x01" + write,
        b"\x01" + write,
        b"\x02" + read(0),
        b"\x01" + read(0),
    ]
    found = run(HalfDuplexPairer("rtu", 0), *((True, crc(f)) for f in frames))
    assert told(found) == [
        (1, read(0), values(7), None), (1, write, write, None), (2, read(0), None, "timeout"),
        (1, read(0), None, "timeout"),
    ]  # fmt: skip


@settings(max_examples=60)
@given(st.lists(st.tuples(st.booleans(), st.binary(max_size=300)), max_size=12))
def test_any_bytes_are_counted_and_nothing_is_raised(steps: list[tuple[bool, bytes]]) -> None:
    for wire in (MbapPairer(0), SerialPairer("rtu", 0), SerialPairer("ascii", 0), HalfDuplexPairer("rtu", 0)):
        for exchange in run(wire, *steps):
            assert exchange.request
            assert (exchange.reply is None) == (exchange.error is not None)
