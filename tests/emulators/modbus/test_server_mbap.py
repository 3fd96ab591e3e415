"""The emulated Modbus TCP server, ADU by ADU: rows 50 to 57 of the list of edge cases."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldtwin.emulators.modbus.bank import CellSpan, MapBank
from fieldtwin.emulators.modbus.mbap import MbapServer
from fieldtwin.emulators.modbus.unit import ModbusUnit
from fieldtwin.gateway.core.errors import UsageError


def adu(transaction: int, unit: int, pdu: str, protocol: int = 0, length: int | None = None) -> bytes:
    data = bytes.fromhex(pdu)
    size = len(data) + 1 if length is None else length
    return b"".join(n.to_bytes(2, "big") for n in (transaction, protocol, size)) + bytes((unit,)) + data


READ = "03 0000 0002"
VALUES = "03 04 00AA 00BB"


def make_server(*unit_ids: int, max_in_flight: int = 16) -> MbapServer:
    units = {}
    for unit_id in unit_ids or (1,):
        bank = MapBank([CellSpan("holding", 0, 125)])
        bank.poke("holding", 0, 0xAA, 0xBB)
        units[unit_id] = ModbusUnit(bank)
    return MbapServer(units, max_in_flight)


OURS = adu(0x1234, 1, READ)
ANSWER = adu(0x1234, 1, VALUES)

ROWS = [
    pytest.param(OURS, [ANSWER], id="a request"),
    pytest.param(OURS + adu(0x1235, 1, "41") + OURS, [ANSWER, adu(0x1235, 1, "C1 01"), ANSWER], id="MB-052 in order"),
    pytest.param(OURS * 16, [ANSWER] * 16, id="MB-052 sixteen"),
    pytest.param(adu(7, 1, READ, protocol=1) + OURS, [ANSWER], id="MB-054 protocol id"),
    pytest.param(adu(7, 1, READ, protocol=0xFFFF) + OURS, [ANSWER], id="MB-054 protocol id FFFFh"),
    pytest.param(b"\x00\x07\x00\x00\x00\x00" + OURS, [ANSWER], id="MB-055 length 0"),
    pytest.param(b"\x00\x07\x00\x00\x00\x01\x01" + OURS, [ANSWER], id="MB-055 length 1"),
    pytest.param(adu(7, 1, "03 00") + OURS, [adu(7, 1, "83 03"), ANSWER], id="MB-055 too small for the function"),
    pytest.param(adu(7, 1, READ + "0000") + OURS, [adu(7, 1, "83 03"), ANSWER], id="MB-055 too large for it"),
    pytest.param(adu(0, 1, READ), [adu(0, 1, VALUES)], id="MB-056 transaction id 0 is echoed"),
    pytest.param(adu(0xFFFF, 1, READ), [adu(0xFFFF, 1, VALUES)], id="MB-056 transaction id FFFFh"),
    pytest.param(adu(5, 255, READ), [adu(5, 255, VALUES)], id="MB-057 unit 255"),
    pytest.param(adu(5, 0, READ), [adu(5, 0, VALUES)], id="MB-057 unit 0"),
    pytest.param(adu(5, 9, READ), [adu(5, 9, "83 0A")], id="a unit that nobody has"),
    pytest.param(adu(5, 9, "83 02") + OURS, [ANSWER], id="MB-035 function from 80h, nobody's"),
    pytest.param(adu(5, 1, "83 02") + OURS, [ANSWER], id="MB-035 function from 80h"),
    pytest.param(adu(5, 1, "08 0000" + "5A" * 250), [adu(5, 1, "08 0000" + "5A" * 250)], id="MB-050 the longest PDU"),
]


@pytest.mark.parametrize(("heard", "expected"), ROWS)
def test_whole_bytewise_and_with_a_tail(heard: bytes, expected: list[bytes]) -> None:
    assert make_server().feed(heard, 0) == expected
    server = make_server()
    assert [r for i in range(len(heard)) for r in server.feed(heard[i : i + 1], i)] == expected, "MB-051"
    server = make_server()
    assert server.feed(heard + OURS[:7], 0) == expected
    assert server.feed(OURS[7:], 0) == [ANSWER]
    one, other = make_server(), make_server()
    assert one.answer(heard + OURS[:7], 0) + one.answer(OURS[7:], 0) == b"".join([*expected, ANSWER])
    assert other.answer(heard, 0) + other.answer(OURS, 0) == b"".join([*expected, ANSWER])
    assert one.requests == other.requests
    assert one.units[1].counters == other.units[1].counters


def test_mb_053_more_at_once_than_allowed() -> None:
    server = make_server(max_in_flight=2)
    writes = [adu(i, 1, f"06 0005 000{i}") for i in range(4)]
    assert server.feed(b"".join(writes), 0) == [writes[0], writes[1], adu(2, 1, "86 06"), adu(3, 1, "86 06")]
    assert server.units[1].bank.read("holding", 5, 1, 0) == [1], "a refused write was executed"
    assert server.feed(writes[3], 0) == [writes[3]]
    counters = server.units[1].counters
    assert (counters.requests, counters.replies, counters.busy) == (5, 5, 2)


@pytest.mark.parametrize("length", [0xFFFF, 255, 0x8000])
def test_mb_055_an_impossible_length_gives_the_stream_up(length: int) -> None:
    server = make_server()
    assert server.feed(OURS + adu(7, 1, READ, length=length) + OURS, 0) == [ANSWER]
    assert server.desync is not None
    assert "2 to 254" in str(server.desync)
    assert server.feed(OURS, 0) == [], "nothing after it can be trusted"
    assert server.answer(OURS, 0) == b""


def test_mb_054_and_055_are_counted() -> None:
    server = make_server()
    server.feed(adu(7, 1, READ, protocol=1) + b"\x00\x07\x00\x00\x00\x00\x00\x07\x00\x00\x00\x01\x01" + OURS, 0)
    assert (server.discarded, server.requests) == (3, 1)


def test_mb_057_several_units_behind_one_address() -> None:
    server = make_server(1, 2)
    assert server.feed(adu(5, 2, READ), 0) == [adu(5, 2, VALUES)]
    assert server.feed(adu(5, 0, READ), 0) == [adu(5, 0, "83 0A")], "0 names nobody in particular there"
    assert server.units[1].counters.requests == 0
    with pytest.raises(UsageError, match="0 to 255"):
        make_server(256)


def test_two_connections_one_unit() -> None:
    one = make_server()
    two = MbapServer(one.units)
    one.feed(OURS[:9], 0)
    assert two.feed(OURS, 0) == [ANSWER]
    assert one.feed(OURS[9:], 0) == [ANSWER]
    assert one.units[1].counters.requests == 2


@given(st.lists(st.binary(max_size=300), max_size=8))
def test_garbage_never_raises_and_stays_bounded(chunks: list[bytes]) -> None:
    server = make_server()
    for chunk in chunks:
        for reply in server.feed(chunk, 0):
            assert len(reply) == 6 + int.from_bytes(reply[4:6], "big")
        assert server.pending < 260


@given(
    st.lists(
        st.one_of(
            st.just(OURS),
            st.binary(min_size=1, max_size=253).map(lambda pdu: adu(9, 1, pdu.hex(), protocol=3)),
            st.just(b"\x00\x01\x00\x00\x00\x01\x01"),
        ),
        max_size=8,
    ),
    st.data(),
)
def test_the_cut_does_not_matter(adus: list[bytes], data: st.DataObject) -> None:
    server = make_server()
    stream = b"".join(adus)
    replies: list[bytes] = []
    at = 0
    while at < len(stream):
        size = data.draw(st.integers(1, 300))
        replies += server.feed(stream[at : at + size], 0)
        at += size
    assert replies == [ANSWER] * adus.count(OURS)
    assert server.pending == 0
