"""The rarer functions of an emulated unit: 07, 0B, 0C, 14, 15, 18, 2B/0E, device-specific ones, hooks and busy answers."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldtwin.emulators.modbus.bank import Acknowledge, CellHooks, CellSpan, IllegalValue, MapBank, NegativeAcknowledge
from fieldtwin.emulators.modbus.functions.fifo import FifoQueues
from fieldtwin.emulators.modbus.functions.file_records import FileRecords
from fieldtwin.emulators.modbus.functions.identification import MAX_OBJECT, Identification
from fieldtwin.emulators.modbus.unit import ALL_FUNCTIONS, ModbusUnit, UnitLimits
from fieldtwin.gateway.core.errors import UsageError

BASIC = {0: b"fieldtwin", 1: b"FT-1", 2: b"V2.11"}


def make_unit(**parts: object) -> ModbusUnit:
    bank = MapBank([CellSpan("holding", 0, 16), CellSpan("coil", 0, 8)])
    return ModbusUnit(bank, server_id=b"ft", **parts)  # type: ignore[arg-type]


def ask(unit: ModbusUnit, request: str, now_ns: int = 0) -> str | None:
    response = unit.respond(bytes.fromhex(request), now_ns)
    return None if response is None else response.hex(" ").upper()


# -- 07, 0B, 0C ---------------------------------------------------------------------------------------------------


def test_function_07_returns_the_exception_status() -> None:
    unit = make_unit()
    assert ask(unit, "07") == "07 00"
    unit.diagnostics.status = 0x6D
    assert ask(unit, "07") == "07 6D"
    assert ask(unit, "07 00") == "87 03"


def test_event_counter_counts_executed_requests() -> None:
    unit = make_unit()
    for request in ("03 0000 0001", "06 0000 0001", "03 0000 0000", "41", "0B", "0C"):
        ask(unit, request)
    unit.execute_broadcast(bytes.fromhex("06 0001 0007"), 0)
    unit.execute_broadcast(bytes.fromhex("06 FFFF 0007"), 0)
    assert ask(unit, "0B") == "0B 00 00 00 03"
    ask(unit, "08 000A 0000")
    assert ask(unit, "0B") == "0B 00 00 00 00", "cleared by the client"
    assert unit.counters.completed == 3, "the evidence is not"


def test_event_log_lists_the_youngest_event_first() -> None:
    unit = make_unit()
    ask(unit, "08 0001 FF00")
    unit.heard(messages=5, errors=1)
    unit.execute_broadcast(bytes.fromhex("06 0001 0007"), 0)
    ask(unit, "41")
    ask(unit, "08 0004 0000")
    ask(unit, "03 0000 0001")
    ask(unit, "08 0001 0000")
    # now; restarted, heard in listen-only mode; a read heard in it; it began, by a message; exception 01; broadcast; damage
    events = "80 00 A0 A0 04 80 41 80 C0 82 40 00"
    response = ask(unit, "0C")
    assert response is not None
    head, log = response[:23], response[24:]
    assert log == events
    assert head == "0C 12 00 00 00 00 00 00", "12h bytes, not busy, nothing carried out, no message since the restart"


def test_event_log_holds_64_and_can_be_cleared() -> None:
    unit = make_unit()
    for _ in range(40):
        ask(unit, "03 0000 0001")
    response = unit.respond(b"\x0c", 0)
    assert response is not None
    assert response[1] == 6 + 64
    ask(unit, "08 0001 FF00")
    assert unit.diagnostics.log.content == b"\x40\x00", "the restart and its response"


def test_a_busy_unit_reports_it_and_can_be_asked_for_the_reason() -> None:
    unit = make_unit()
    unit.be_busy(until_ns=100)
    assert ask(unit, "06 0000 0001", 99) == "86 06"
    unit.execute_broadcast(bytes.fromhex("06 0000 0001"), 99)
    assert unit.bank.read("holding", 0, 1, 0) == [0]
    assert ask(unit, "0B", 99) == "0B FF FF 00 00"
    assert ask(unit, "08 0011 0000", 99) == "08 00 11 00 01"
    assert ask(unit, "06 0000 0001", 100) == "06 00 00 00 01"
    assert ask(unit, "0B", 100) == "0B 00 00 00 02", "the write and the question for the counter"


def test_a_refused_program_function_counts_as_a_nak() -> None:
    unit = make_unit()

    def refuse(pdu: bytes, now_ns: int) -> bytes:
        raise NegativeAcknowledge("no program")

    unit.register(0x0D, refuse)
    assert ask(unit, "0D 00") == "8D 07"
    assert ask(unit, "08 0010 0000") == "08 00 10 00 01"
    assert unit.diagnostics.log.content[2] == 0x48


def test_diagnostic_register_and_overruns_are_cleared_apart() -> None:
    unit = make_unit()
    unit.diagnostics.register = 0x1234
    unit.counters.overruns = 3
    assert ask(unit, "08 0002 0000") == "08 00 02 12 34"
    assert ask(unit, "08 0012 0000") == "08 00 12 00 03"
    ask(unit, "08 0014 0000")
    assert ask(unit, "08 0012 0000") == "08 00 12 00 00"
    assert ask(unit, "08 000E 0000") == "08 00 0E 00 05", "the other counters go on"
    ask(unit, "08 000A 0000")
    assert ask(unit, "08 0002 0000") == "08 00 02 00 00"


def test_function_11h_returns_the_run_indicator() -> None:
    unit = make_unit()
    assert ask(unit, "11") == "11 03 66 74 FF"
    unit.running = False
    assert ask(unit, "11") == "11 03 66 74 00"


# -- 14h, 15h -----------------------------------------------------------------------------------------------------


def make_files() -> FileRecords:
    files = FileRecords({3: 20, 4: 300, 5: 10}, read_only=[5])
    files.poke(4, 1, 0x0DFE, 0x0020)
    files.poke(3, 9, 0x33CD, 0x0040)
    return files


@pytest.mark.parametrize(
    ("request_hex", "expected"),
    [
        pytest.param(
            "14 0E 06 0004 0001 0002 06 0003 0009 0002",
            "14 0C 05 06 0D FE 00 20 05 06 33 CD 00 40",
            id="AP-6.14 two groups",
        ),
        pytest.param("14 07 06 0003 0013 0001", "14 04 03 06 00 00", id="the last record"),
        pytest.param("14 07 06 0003 0013 0002", "94 02", id="beyond the last record"),
        pytest.param("14 07 06 0003 2710 0001", "94 02", id="record 10000"),
        pytest.param("14 07 06 0003 0000 0000", "94 02", id="no record"),
        pytest.param("14 07 06 0000 0000 0001", "94 02", id="file 0"),
        pytest.param("14 07 06 0007 0000 0001", "94 02", id="a file that is not there"),
        pytest.param("14 07 05 0003 0000 0001", "94 02", id="reference type 5"),
        pytest.param("14 06 06 0003 0000 00", "94 03", id="byte count 6"),
        pytest.param("14 08 06 0003 0000 0001 00", "94 03", id="byte count 8"),
        pytest.param("14 07 06 0003 0000", "94 03", id="byte count and length differ"),
        pytest.param("14", "94 03", id="function only"),
        pytest.param("14 FC" + " 06 0003 0000 0001" * 36, "94 03", id="more than 245 bytes asked"),
        pytest.param("14 07 06 0004 0000 0079", "14 F4 F3 06 00 00 0D FE 00 20" + " 00" * 236, id="121 records"),
        pytest.param("14 07 06 0004 0000 007A", "94 03", id="more than 245 bytes to answer"),
        pytest.param(
            "15 0D 06 0004 0007 0003 06AF 04BE 100D", "15 0D 06 00 04 00 07 00 03 06 AF 04 BE 10 0D", id="AP-6.15"
        ),
        pytest.param("15 09 06 0005 0000 0001 0001", "95 02", id="read-only file written"),
        pytest.param("15 09 06 0003 0014 0001 0001", "95 02", id="written beyond the end"),
        pytest.param("15 09 06 0003 0000 0002 0001", "95 03", id="fewer records than counted"),
        pytest.param("15 0A 06 0003 0000 0001 0001 00", "95 03", id="a byte too many"),
        pytest.param("15 07 06 0003 0000 0000", "95 03", id="nothing to write"),
        pytest.param("15 12 06 0003 0000 0001 0005 06 0007 0000 0001 0001", "95 02", id="second group refused"),
    ],
)
def test_file_records_are_read_and_written(request_hex: str, expected: str) -> None:
    files = make_files()
    before = {f: files.peek(f, 0, n) for f, n in ((3, 20), (4, 300), (5, 10))}
    assert ask(make_unit(files=files), request_hex) == expected
    if not expected.startswith("15"):
        assert {f: files.peek(f, 0, n) for f, n in ((3, 20), (4, 300), (5, 10))} == before, "nothing changed"
    else:
        assert files.peek(4, 7, 3) == [0x06AF, 0x04BE, 0x100D]


def test_impossible_files_are_refused() -> None:
    for sizes in ({0: 1}, {0x10000: 1}, {1: 0}, {1: 10_001}):
        with pytest.raises(UsageError, match="file"):
            FileRecords(sizes)


# -- 18h ----------------------------------------------------------------------------------------------------------


def test_mb_044_fifo() -> None:
    fifos = FifoQueues([0x04DE], capacity=33)
    unit = make_unit(fifos=fifos)
    assert ask(unit, "18 04DE") == "18 00 02 00 00"
    fifos.push(0x04DE, 0x01B8, 0x1284)
    assert ask(unit, "18 04DE") == "18 00 06 00 02 01 B8 12 84", "AP 6.18"
    assert ask(unit, "18 04DE") == "18 00 06 00 02 01 B8 12 84", "reading takes nothing out"
    fifos.push(0x04DE, *range(29))
    answer = unit.respond(bytes.fromhex("18 04DE"), 0)
    assert answer is not None
    assert len(answer) == 3 + 2 + 62
    fifos.push(0x04DE, 1, 2, 3)
    assert fifos.dropped == 1
    assert ask(unit, "18 04DE") == "98 03", "more than 31"
    assert fifos.take(0x04DE, 40)[:3] == [0x01B8, 0x1284, 0]
    assert ask(unit, "18 0000") == "98 02"
    assert ask(unit, "18 04") == "98 03"
    with pytest.raises(IllegalValue):
        fifos.push(0x04DE, 0x10000)


# -- 2Bh / 0Eh ----------------------------------------------------------------------------------------------------


def test_mb_045_identification_in_one_frame() -> None:
    unit = make_unit(identification=Identification(BASIC))
    whole = "2B 0E 01 81 00 00 03 00 09 66 69 65 6C 64 74 77 69 6E 01 04 46 54 2D 31 02 05 56 32 2E 31 31"
    assert ask(unit, "2B 0E 01 00") == whole
    assert ask(unit, "2B 0E 03 00") == whole.replace("0E 01", "0E 03", 1), "no more than there is"
    assert ask(unit, "2B 0E 01 02") == "2B 0E 01 81 00 00 01 02 05 56 32 2E 31 31"
    assert ask(unit, "2B 0E 01 05") == whole, "an unknown object: from the beginning"
    assert ask(unit, "2B 0E 04 01") == "2B 0E 04 81 00 00 01 01 04 46 54 2D 31"
    assert ask(unit, "2B 0E 04 05") == "AB 02", "an unknown object alone"
    assert ask(unit, "2B 0E 00 00") == "AB 03"
    assert ask(unit, "2B 0E 05 00") == "AB 03"
    assert ask(unit, "2B 0E 01") == "AB 03"
    assert ask(unit, "2B 0D 00 00") == "AB 01", "CANopen general reference: not here"
    assert ask(unit, "2B") == "AB 01"


def read_stream(unit: ModbusUnit, code: int) -> tuple[dict[int, bytes], int]:
    found: dict[int, bytes] = {}
    following, frames = 0, 0
    while True:
        answer = unit.respond(bytes((0x2B, 0x0E, code, following)), 0)
        assert answer is not None
        assert len(answer) <= 253
        assert answer[:3] == bytes((0x2B, 0x0E, code))
        frames += 1
        at = 7
        for _ in range(answer[6]):
            number, size = answer[at], answer[at + 1]
            assert number not in found
            found[number] = answer[at + 2 : at + 2 + size]
            at += 2 + size
        assert at == len(answer)
        if answer[4] == 0:
            assert answer[5] == 0
            return found, frames
        assert answer[4] == 0xFF
        assert answer[5] > following
        following = answer[5]


@given(
    st.dictionaries(st.integers(3, 255), st.binary(max_size=MAX_OBJECT), max_size=12),
    st.binary(max_size=MAX_OBJECT),
)
def test_mb_045_identification_in_several_frames(more: dict[int, bytes], vendor: bytes) -> None:
    objects = {**BASIC, **more, 0: vendor}
    unit = make_unit(identification=Identification(objects))
    for code, last in ((1, 2), (2, 0x7F), (3, 0xFF)):
        found, frames = read_stream(unit, code)
        assert found == {n: v for n, v in objects.items() if n <= last}
        assert frames <= len(objects)
    for number, value in objects.items():
        answer = unit.respond(bytes((0x2B, 0x0E, 4, number)), 0)
        assert answer is not None
        assert answer[7:] == bytes((number, len(value))) + value
    level = 3 if max(objects) > 0x7F else 2 if max(objects) > 2 else 1
    assert answer[3] == 0x80 | level


def test_mb_045_more_follows() -> None:
    objects = {**BASIC, 3: b"u" * 200, 4: b"n" * 240, 0x80: b"x" * 9}
    _, frames = read_stream(make_unit(identification=Identification(objects)), 3)
    assert frames == 3


def test_impossible_identifications_are_refused() -> None:
    with pytest.raises(UsageError, match="none numbered 2"):
        Identification({0: b"", 1: b""})
    for number, value in ((256, b""), (3, bytes(MAX_OBJECT + 1))):
        with pytest.raises(UsageError, match="identification object"):
            Identification({**BASIC, number: value})


# -- device-specific behaviour ------------------------------------------------------------------------------------------


def test_functions_of_the_device_s_own() -> None:
    """Renogy's 78h (factory reset) and 79h (clear history): a fixed request, echoed."""
    resets: list[int] = []

    def reset(pdu: bytes, now_ns: int) -> bytes:
        if pdu != b"\x78\x00\x01\x00\x01":
            raise IllegalValue("factory reset", got=pdu.hex())
        resets.append(now_ns)
        return pdu

    unit = make_unit()
    assert ask(unit, "78 0001 0001") == "F8 01"
    unit.register(0x78, reset)
    unit.register(0x79, lambda pdu, now_ns: None, broadcast=True)
    assert ask(unit, "78 0001 0001", 5) == "78 00 01 00 01"
    assert ask(unit, "78 0001 0002", 6) == "F8 03"
    assert ask(unit, "79 0000 0001") is None, "silence is an answer too"
    unit.execute_broadcast(bytes.fromhex("78 0001 0001"), 7)
    assert resets == [5], "not registered for broadcasts"
    before = unit.counters.completed
    unit.execute_broadcast(bytes.fromhex("79 0000 0001"), 8)
    assert unit.counters.completed == before + 1
    with pytest.raises(UsageError, match="1 to 127"):
        unit.register(0x80, reset)


def test_only_the_functions_of_the_profile() -> None:
    unit = make_unit(limits=UnitLimits(functions=frozenset({3, 0x78})), fifos=FifoQueues([0]))
    for function in ALL_FUNCTIONS - {3}:
        assert ask(unit, f"{function:02X} 0000 0001") == f"{function | 0x80:02X} 01"
    assert ask(unit, "78") == "F8 01"


def test_registers_with_side_effects() -> None:
    bank = MapBank([CellSpan("holding", 0, 8)])
    unit = ModbusUnit(bank)

    def clearing(value: int, now_ns: int) -> int:
        bank.poke("holding", 0, 0)
        return value

    def only_small(value: int, now_ns: int) -> None:
        if value > 10:
            raise IllegalValue("too much")
        if value == 9:
            raise Acknowledge("takes long")

    def command(value: int, now_ns: int) -> None:
        bank.poke("holding", 3, value * 2)
        bank.poke("holding", 2, 0)  # a command register reads 0 again

    bank.poke("holding", 0, 77)
    bank.hook("holding", 0, CellHooks(reading=clearing))
    bank.hook("holding", 1, CellHooks(reading=lambda value, now_ns: now_ns))
    bank.hook("holding", 2, CellHooks(checking=only_small, written=command))
    assert ask(unit, "17 0000 0002 0004 0001 02 0001", 5) == "17 04 00 4D 00 05", "read once, not twice"
    assert ask(unit, "03 0000 0002", 6) == "03 04 00 00 00 06"
    assert ask(unit, "10 0001 0003 06 0001 0004 0063") == "10 00 01 00 03"
    assert [bank.peek("holding", a) for a in range(4)] == [0, 1, 0, 8]
    before = [bank.peek("holding", a) for a in range(8)]
    assert ask(unit, "10 0001 0003 06 0005 000B 0063") == "90 03"
    assert ask(unit, "06 0002 0009") == "86 05"
    assert [bank.peek("holding", a) for a in range(8)] == before, "MB-041 a cell's veto is the whole request's"


@given(
    st.sampled_from(sorted(ALL_FUNCTIONS)),
    st.binary(max_size=252),
)
def test_any_data_is_answered_or_refused_within_a_pdu(function: int, data: bytes) -> None:
    fifos = FifoQueues([0, 0x0101])
    unit = make_unit(identification=Identification({**BASIC, 6: bytes(240)}), files=make_files(), fifos=fifos)
    response = unit.respond(bytes((function,)) + data, 0)
    if response is None:
        assert bytes((function,)) + data[:2] in (b"\x08\x00\x04",)
        return
    assert response[0] & 0x7F == function
    assert len(response) <= 253
    assert not response[0] & 0x80 or response[1] in (1, 2, 3)
