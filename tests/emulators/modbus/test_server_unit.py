"""The emulated unit, PDU by PDU: rows of the list of edge cases that need no framing, and the examples of AP 6."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldtwin.emulators.modbus.bank import (
    Acknowledge,
    CellSpan,
    DeviceIsBusy,
    IllegalValue,
    MapBank,
    NoSuchAddress,
    Refusal,
    Table,
)
from fieldtwin.emulators.modbus.unit import ALL_FUNCTIONS, ModbusUnit, UnitLimits
from fieldtwin.gateway.core.errors import UsageError


def make_bank() -> MapBank:
    bank = MapBank(
        [
            CellSpan("coil", 0, 37),
            CellSpan("coil", 40, 8),  # a gap from 37 to 39
            CellSpan("discrete", 0xC4, 22),
            CellSpan("holding", 0, 200),
            CellSpan("holding", 300, 1, access="ro"),
            CellSpan("holding", 301, 1, access="wo"),
            CellSpan("holding", 0xFFF0, 16),
            CellSpan("input", 0, 200),
            CellSpan("input", 0xFFFF, 1),
        ]
    )
    # AP 6.1: coils 20 to 38 are CD 6B 05
    bank.poke("coil", 19, *[0xCD6B05 >> shift & 1 for shift in (*range(16, 24), *range(8, 16), *range(2))])
    bank.poke("holding", 107, 555, 0, 100)  # AP 6.3
    bank.poke("holding", 4, 0x12)  # AP 6.16
    bank.poke("input", 0, 0x4120, 0x0000)
    return bank


def ask(unit: ModbusUnit, request: str) -> str | None:
    response = unit.respond(bytes.fromhex(request), 0)
    return None if response is None else response.hex(" ").upper()


ROWS = [
    pytest.param("01 00 13 00 12", "01 03 CD 6B 01", id="AP-6.1 coils, padding 0"),
    pytest.param("02 00 C4 00 16", "02 03 00 00 00", id="AP-6.2 discrete inputs"),
    pytest.param("03 00 6B 00 03", "03 06 02 2B 00 00 00 64", id="AP-6.3 holding registers"),
    pytest.param("04 00 00 00 02", "04 04 41 20 00 00", id="AP-6.4 input registers"),
    pytest.param("04 FF FF 00 01", "04 02 00 00", id="the last address of a table"),
    pytest.param("05 00 1E FF 00", "05 00 1E FF 00", id="AP-6.5 coil on"),
    pytest.param("06 00 01 00 03", "06 00 01 00 03", id="AP-6.6 register"),
    pytest.param("08 00 00 A5 37", "08 00 00 A5 37", id="AP-6.8 echo"),
    pytest.param("08 00 00" + " 11" * 20, "08 00 00" + " 11" * 20, id="echo of more than two bytes"),
    pytest.param("08 00 00", "08 00 00", id="echo of nothing"),
    pytest.param("08 00 02 00 00", "08 00 02 00 00", id="diagnostic register"),
    pytest.param("08 00 05 00 00", "88 01", id="sub-function that is not there"),
    pytest.param("08 00 03 3B 00", "08 00 03 3B 00", id="AP-6.8 delimiter"),
    pytest.param("08 00 03 41 00", "88 03", id="a delimiter that is a digit"),
    pytest.param("08 00 0B 00 01", "88 03", id="diagnostic data field not 0"),
    pytest.param("08 00", "88 03", id="no sub-function"),
    pytest.param("0F 00 13 00 0A 02 CD 01", "0F 00 13 00 0A", id="AP-6.11 coils"),
    pytest.param("10 00 01 00 02 04 00 0A 01 02", "10 00 01 00 02", id="AP-6.12 registers"),
    pytest.param("11", "11 05 66 74 20 31 FF", id="AP-6.13 server id"),
    pytest.param("16 00 04 00 F2 00 25", "16 00 04 00 F2 00 25", id="AP-6.16 mask"),
    # MB-033 to MB-049
    pytest.param("41", "C1 01", id="MB-033 unknown function"),
    pytest.param("00 00 00", "80 01", id="MB-033 function 0"),
    pytest.param("2B 0E 01 00", "AB 01", id="MB-033 function the device has not"),
    pytest.param("83 02", None, id="MB-035 function from 80h: silence"),
    pytest.param("FF", None, id="MB-035 function FFh: silence"),
    pytest.param("80 00", None, id="MB-035 function 80h: silence"),
    pytest.param("", None, id="no PDU at all"),
    pytest.param("03 00 00 00 00", "83 03", id="MB-036 no register"),
    pytest.param("03 00 00 00 7E", "83 03", id="MB-036 126 registers"),
    pytest.param("04 00 00 00 7E", "84 03", id="MB-036 126 input registers"),
    pytest.param("01 00 00 07 D1", "81 03", id="MB-036 2001 coils"),
    pytest.param("02 00 00 00 00", "82 03", id="MB-036 no discrete input"),
    pytest.param("10 00 00 00 00 00", "90 03", id="MB-036 write nothing"),
    pytest.param("10 00 00 00 7C F8" + " 00" * 248, "90 03", id="MB-036 write 124 registers"),
    pytest.param("0F 00 00 07 B1 F7" + " 00" * 247, "8F 03", id="MB-036 write 1969 coils"),
    pytest.param("03 FF FF 00 02", "83 02", id="MB-037 beyond the table"),
    pytest.param("01 FF FF 00 02", "81 02", id="MB-037 coils beyond the table"),
    pytest.param("10 FF FF 00 02 04 00 00 00 00", "90 02", id="MB-037 write beyond the table"),
    pytest.param("03 FF FF 00 7E", "83 03", id="MB-038 both wrong: 03 first"),
    pytest.param("01 FF FF 07 D1", "81 03", id="MB-038 both wrong, coils"),
    pytest.param("05 FF FF 12 34", "85 03", id="MB-038 both wrong, one coil"),
    pytest.param("05 00 00 00 01", "85 03", id="MB-039 coil value 0001h"),
    pytest.param("05 00 00 FF 01", "85 03", id="MB-039 coil value FF01h"),
    pytest.param("0F 00 00 00 0A 01 FF", "8F 03", id="MB-040 byte count too small for the count"),
    pytest.param("10 00 01 00 02 03 00 0A 01", "90 03", id="MB-040 odd byte count"),
    pytest.param("10 00 01 00 02 04 00 0A", "90 03", id="MB-040 byte count larger than the data"),
    pytest.param("10 00 01 00 02 04 00 0A 01 02 03", "90 03", id="MB-040 data longer than the byte count"),
    pytest.param("17 00 00 00 01 00 01 00 01 04 00 0A", "97 03", id="MB-040 in a read and write"),
    pytest.param("10 00 C7 00 02 04 00 01 00 02", "90 02", id="MB-041 partly outside"),
    pytest.param("17 00 03 00 02 00 04 00 01 02 00 FF", "17 04 00 00 00 FF", id="MB-042 write before read"),
    pytest.param("17 00 FF 00 01 00 04 00 01 02 00 FF", "97 02", id="MB-042 read refused"),
    pytest.param("17 00 00 00 7E 00 04 00 01 02 00 FF", "97 03", id="MB-042 126 read"),
    pytest.param("17 00 00 00 01 00 00 00 7A F4" + " 00" * 244, "97 03", id="MB-042 122 written"),
    pytest.param("16 00 04 00 F2 00", "96 03", id="MB-043 too short"),
    pytest.param("01 00 24 00 03", "81 02", id="MB-049 gap in the coils"),
    pytest.param("01 00 28 00 03", "01 01 00", id="MB-049 behind the gap"),
    pytest.param("03 01 2D 00 01", "83 02", id="write-only register read"),
    pytest.param("06 01 2C 00 01", "86 02", id="read-only register written"),
    pytest.param("16 01 2D 00 00 00 01", "96 02", id="mask on a write-only register"),
    pytest.param("03 00 00 00", "83 03", id="request too short"),
    pytest.param("03 00 00 00 01 00", "83 03", id="request too long"),
    pytest.param("03", "83 03", id="function only"),
    pytest.param("0F 00 00", "8F 03", id="coil write too short"),
    pytest.param("17 00 00", "97 03", id="read and write too short"),
]


@pytest.mark.parametrize(("request_hex", "expected"), ROWS)
def test_each_request_gets_the_expected_answer(request_hex: str, expected: str | None) -> None:
    bank = make_bank()
    unit = ModbusUnit(bank, server_id=b"ft 1")
    before = snapshot(bank)
    assert ask(unit, request_hex) == expected
    if expected is None or int(expected[:2], 16) & 0x80:
        assert snapshot(bank) == before, "a refused request changed something"
    # MB-034: after any request, the next one is answered
    assert ask(unit, "03 00 6B 00 01") == "03 02 02 2B"


def snapshot(bank: MapBank) -> dict[object, int]:
    return {(table, a): value for table, cells in bank._cells.items() for a, value in cells.items()}


def test_written_values_are_in_the_bank() -> None:
    bank = make_bank()
    unit = ModbusUnit(bank)
    ask(unit, "05 00 1E FF 00")
    assert bank.peek("coil", 30) == 1
    ask(unit, "05 00 1E 00 00")
    assert bank.peek("coil", 30) == 0
    ask(unit, "0F 00 13 00 0A 02 CD 01")
    assert [bank.peek("coil", a) for a in range(19, 29)] == [1, 0, 1, 1, 0, 0, 1, 1, 1, 0]
    ask(unit, "10 00 01 00 02 04 00 0A 01 02")
    assert [bank.peek("holding", a) for a in (1, 2)] == [10, 0x102]


def test_mb_043_mask_write() -> None:
    bank = make_bank()
    ask(ModbusUnit(bank), "16 00 04 00 F2 00 25")
    assert bank.peek("holding", 4) == 0x17


@pytest.mark.parametrize(
    ("request_hex", "expected"),
    [
        pytest.param("04 00 00 00 02", "04 04 41 20 00 00", id="whole value"),
        pytest.param("04 00 00 00 03", "84 03", id="MB-048 odd count"),
        pytest.param("04 00 01 00 02", "84 02", id="MB-048 half a value"),
        pytest.param("04 00 01 00 03", "84 03", id="MB-048 both: 03 first"),
        pytest.param("04 00 00 00 52", "84 03", id="more than this device allows"),
        pytest.param("03 00 00 00 02", "83 01", id="function this device has not"),
        pytest.param("10 00 00 00 01 02 00 01", "90 03", id="MB-048 half a value written"),
        pytest.param("11", "91 01", id="no server id"),
    ],
)
def test_limits_of_the_profile(request_hex: str, expected: str) -> None:
    limits = UnitLimits(functions=frozenset({4, 16}), read_registers=80, even_only=True)
    assert ask(ModbusUnit(make_bank(), limits), request_hex) == expected


def test_limits_beyond_the_protocol_are_refused() -> None:
    with pytest.raises(UsageError, match="1 to 125"):
        UnitLimits(read_registers=126)
    with pytest.raises(UsageError, match="80h"):
        UnitLimits(functions=frozenset({0x80}))


def test_mb_041_a_veto_of_the_device_changes_nothing() -> None:
    """A device that refuses a value in the middle of a write leaves all its registers unchanged."""

    def veto(table: Table, address: int, values: tuple[int, ...], now_ns: int) -> None:
        seen.append((table, address, values, now_ns))
        if 99 in values:
            raise refusing[-1]

    seen: list[object] = []
    refusing: list[Refusal] = []
    bank = MapBank([CellSpan("holding", 0, 4)], on_write=veto)
    unit = ModbusUnit(bank)
    for refusal, code in (
        (IllegalValue("99"), 3),
        (DeviceIsBusy("later"), 6),
        (Acknowledge("slow"), 5),
        (Refusal("broken"), 4),
    ):
        refusing.append(refusal)
        assert unit.respond(bytes.fromhex("10 0000 0002 04 0001 0063"), 77) == bytes((0x90, code))
        assert [bank.peek("holding", a) for a in range(4)] == [0, 0, 0, 0]
    assert unit.respond(bytes.fromhex("10 0002 0001 02 0005"), 78) == bytes.fromhex("10 0002 0001")
    assert seen[-1] == ("holding", 2, (5,), 78)
    assert bank.peek("holding", 2) == 5
    assert unit.counters.busy == 1
    assert unit.counters.exceptions == 4


def test_mb_026_and_027_broadcast() -> None:
    bank = make_bank()
    unit = ModbusUnit(bank)
    unit.execute_broadcast(bytes.fromhex("06 0001 0007"), 0)
    assert bank.peek("holding", 1) == 7
    before = snapshot(bank)
    for silent in ("03 0000 0001", "06 FFEE 0001", "17 0000 0001 0001 0001 02 0009", "41", "", "86 03"):
        unit.execute_broadcast(bytes.fromhex(silent), 0)
    assert snapshot(bank) == before
    assert (unit.counters.broadcasts, unit.counters.requests, unit.counters.replies) == (7, 0, 0)
    assert unit.counters.exceptions == 0, "an exception that nobody was sent is none"


def test_mb_046_listen_only() -> None:
    bank = make_bank()
    unit = ModbusUnit(bank)
    assert ask(unit, "08 00 04 00 00") is None
    assert ask(unit, "06 00 01 00 07") is None
    assert ask(unit, "08 00 00 12 34") is None
    unit.execute_broadcast(bytes.fromhex("06 0001 0007"), 0)
    assert bank.peek("holding", 1) == 0, "monitored, not executed"
    assert ask(unit, "08 00 01 00 00") is None, "the restart itself is not answered"
    assert ask(unit, "08 00 00 12 34") == "08 00 00 12 34"
    assert ask(unit, "08 00 01 FF 00") == "08 00 01 FF 00", "outside listen-only a restart is answered"


def test_mb_047_counters_of_the_unit() -> None:
    unit = ModbusUnit(make_bank())

    def counter(sub: int) -> int:
        response = unit.respond(bytes((8, 0, sub, 0, 0)), 0)
        assert response is not None
        return int.from_bytes(response[3:], "big")

    ask(unit, "03 00 00 00 01")
    ask(unit, "03 00 00 00 00")
    unit.execute_broadcast(bytes.fromhex("06 0001 0007"), 0)
    unit.heard(messages=9, errors=2)
    assert counter(0x0B) == 9
    assert counter(0x0C) == 2
    assert counter(0x0D) == 1
    assert counter(0x0E) == 7, "two, a broadcast, three for counters, and the one that asks"
    assert counter(0x0F) == 1
    assert [counter(sub) for sub in (0x10, 0x11, 0x12)] == [0, 0, 0]
    assert ask(unit, "08 00 14 00 00") == "08 00 14 00 00"
    assert ask(unit, "08 00 0A 00 00") == "08 00 0A 00 00"
    assert [counter(sub) for sub in (0x0B, 0x0C, 0x0D, 0x0F)] == [0, 0, 0, 0]
    assert unit.counters.exceptions == 1, "a client cannot clear the evidence"
    unit.counters.bus_messages += 0x10000
    assert counter(0x0B) == 0, "16 bits, wrapping"


def test_counters_add_up() -> None:
    unit = ModbusUnit(make_bank())
    for request in ("03 00 00 00 01", "03 00 00 00 00", "83 01", "41"):
        ask(unit, request)
    counters = unit.counters
    assert (counters.requests, counters.replies, counters.exceptions, counters.unanswered) == (4, 3, 2, 1)
    assert unit.refuse_busy(b"\x03\x00\x00\x00\x01") == b"\x83\x06"
    assert (counters.busy, counters.replies) == (1, 4)


def test_bank_refuses_impossible_values() -> None:
    with pytest.raises(UsageError, match="same cell"):
        MapBank([CellSpan("coil", 0, 2), CellSpan("coil", 1, 1)])
    with pytest.raises(UsageError, match="addresses"):
        CellSpan("coil", 0xFFFF, 2)
    bank = MapBank([CellSpan("coil", 0, 2), CellSpan("input", 0, 1)])
    with pytest.raises(IllegalValue):
        bank.poke("coil", 0, 2)
    with pytest.raises(IllegalValue):
        bank.poke("input", 0, 0x10000)
    with pytest.raises(NoSuchAddress):
        bank.poke("coil", 1, 1, 1)
    assert bank.peek("coil", 1) == 0


@given(st.binary(max_size=260))
def test_any_pdu_is_answered_with_its_function_or_not_at_all(pdu: bytes) -> None:
    unit = ModbusUnit(make_bank(), server_id=b"x")
    response = unit.respond(pdu, 0)
    if response is None:
        assert not pdu or pdu[0] >= 0x80 or pdu[:3] == b"\x08\x00\x04"
        return
    assert response[0] & 0x7F == pdu[0]
    if response[0] & 0x80:
        assert response[1:] in (b"\x01", b"\x02", b"\x03")
    assert len(response) <= 253 or pdu[:3] == b"\x08\x00\x00"


@given(
    st.sampled_from(sorted(ALL_FUNCTIONS)),
    st.integers(0, 0xFFFF),
    st.integers(0, 0xFFFF),
    st.binary(max_size=246),
)
def test_sensible_heads_never_break_the_unit(function: int, address: int, count: int, data: bytes) -> None:
    unit = ModbusUnit(make_bank(), server_id=b"x")
    head = bytes((function,)) + address.to_bytes(2, "big") + count.to_bytes(2, "big")
    for pdu in (head, head + bytes((len(data) % 256,)) + data, head + head[1:] + bytes((len(data) % 256,)) + data):
        response = unit.respond(pdu, 0)
        assert response is None or response[0] & 0x7F == function
