"""An RTU request with a correct CRC whose byte count contradicts its length is answered with exception 03 (AP 7), as on TCP.

Defect: it was treated as noise and not answered, so that libmodbus's unit-test-client stopped there. MB-040 did not catch it:
its byte count contradicted only the number of registers, never the length of the frame.
"""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldtwin.emulators.modbus.bank import CellSpan, MapBank
from fieldtwin.emulators.modbus.mbap import MbapServer
from fieldtwin.emulators.modbus.rtu.line import RtuServer
from fieldtwin.emulators.modbus.rtu.receiver import FRAME_GAP_NS
from fieldtwin.emulators.modbus.unit import ModbusUnit
from fieldtwin.gateway.protocols.modbus.frames.crc import with_crc
from fieldtwin.gateway.protocols.modbus.server.line import RtuRequests

WRONG = {
    "registers, byte count below the length": "10 0001 0001 02 0A0B 0C0D",
    "registers, byte count above the length": "10 0001 0001 04 0A0B",
    "registers, none and byte count 0 with data": "10 0001 0000 00 0A0B 0C0D",
    "registers, too many, byte count 248": "10 0001 007C F8 0A0B 0C0D",
    "coils, none and byte count 0 with data": "0F 0001 0000 00 0A0B 0C0D",
    "coils, too many, byte count cut to one byte": "0F 0001 07B1 B1 0A0B 0C0D",
    "read and write, byte count below the length": "17 0001 0001 0001 0001 02 0A0B 0C0D",
    "a read that is too long": "03 0001 0001 00",
    "a read that is too short": "03 0001 01",
}


def make_unit() -> ModbusUnit:
    return ModbusUnit(MapBank([CellSpan("holding", 0, 10), CellSpan("coil", 0, 10)]))


@pytest.mark.parametrize("hexadecimal", WRONG.values(), ids=WRONG)
@pytest.mark.parametrize("piece", [256, 1, 3], ids=["at once", "byte by byte", "in pieces of three"])
def test_the_answer_is_exception_03_as_on_tcp(hexadecimal: str, piece: int) -> None:
    pdu = bytes.fromhex(hexadecimal)
    unit = make_unit()
    server = RtuServer({7: unit})
    frame = with_crc(b"\x07" + pdu)
    replies = [reply for at in range(0, len(frame), piece) for reply in server.feed(frame[at : at + piece], 1000 + at)]
    replies += server.feed(b"", 2000 + FRAME_GAP_NS)
    assert replies == [with_crc(bytes((7, pdu[0] | 0x80, 0x03)))]
    assert not any(unit.bank.read("holding", 0, 10, 0))
    assert server.counters.crc_errors == 0
    adu = (len(pdu) + 1).to_bytes(2)
    on_tcp = MbapServer({7: make_unit()}).feed(b"\0\1\0\0" + adu + b"\x07" + pdu, 0)
    assert b"".join(on_tcp)[7:] == bytes((pdu[0] | 0x80, 0x03))


@pytest.mark.parametrize("hexadecimal", WRONG.values(), ids=WRONG)
def test_a_request_to_another_unit_of_a_wrong_length_gets_silence(hexadecimal: str) -> None:
    server = RtuServer({7: make_unit()})
    assert server.feed(with_crc(b"\x08" + bytes.fromhex(hexadecimal)), 0) == []
    assert server.feed(b"", FRAME_GAP_NS) == []


@pytest.mark.parametrize("hexadecimal", WRONG.values(), ids=WRONG)
def test_a_good_request_after_a_wrong_length_is_answered(hexadecimal: str) -> None:
    server = RtuServer({7: make_unit()})
    server.feed(with_crc(b"\x07" + bytes.fromhex(hexadecimal)), 0)
    replies = server.feed(with_crc(bytes.fromhex("07 03 0000 0001")), FRAME_GAP_NS)
    assert replies[-1] == with_crc(bytes.fromhex("07 03 02 0000"))


@given(st.binary(max_size=300), st.integers(1, 64))
def test_noise_is_answered_only_if_its_check_sum_is_right(data: bytes, piece: int) -> None:
    """An invalid frame is never answered, however it is divided."""
    server = RtuServer({7: make_unit()})
    heard = [e for at in range(0, len(data), piece) for e in server.receive(data[at : at + piece], at)]
    heard += server.receive(b"", 1000 + FRAME_GAP_NS)
    assert all(with_crc(e.heard[:-2]) == e.heard for e in heard)


@pytest.mark.parametrize("hexadecimal", WRONG.values(), ids=WRONG)
@pytest.mark.parametrize("piece", [256, 1])
def test_the_bridge_passes_a_wrong_length_on_to_the_requested_device(hexadecimal: str, piece: int) -> None:
    pdu = bytes.fromhex(hexadecimal)
    line = RtuRequests(500_000, [7])
    frame = with_crc(b"\x07" + pdu)
    found = [r for at in range(0, len(frame), piece) for r in line.feed(frame[at : at + piece])]
    assert line.pending or found
    found += line.silence()
    assert [(r.unit, r.pdu) for r in found] == [(7, pdu)]
    assert not line.pending
    assert line.noise_bytes == 0
    assert [r.pdu for r in line.feed(with_crc(bytes.fromhex("07 03 0000 0001")))] == [bytes.fromhex("03 0000 0001")]
