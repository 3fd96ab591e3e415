"""Schemas EmulatedConnection, Emulator, SensorEmulator."""

from __future__ import annotations

import inspect
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st
from spec_rig import observatory

from fieldtwin.emulators.context import EndOfRecording, Recorded, UsedUp, VirtualContext
from fieldtwin.emulators.emulator import Emulator, SensorEmulator
from fieldtwin.emulators.link import EmulatedConnection
from fieldtwin.emulators.replay.replay import ExchangeReplay
from fieldtwin.emulators.replay.unit import ReplayUnit
from fieldtwin.gateway.core.connection import PROTOCOL, Connection, RS232Connection, TCPConnection
from fieldtwin.gateway.core.device import Device, End, Sensor, wire
from fieldtwin.gateway.core.errors import Bug, UnknownCommand
from fieldtwin.gateway.core.files.recording import RecordedExchange
from fieldtwin.gateway.core.values import COMMAND, RECORDING

CTD = observatory()[0].devices["ctd"].profile
READ_STATUS = bytes.fromhex("03 0000 0001")
WORDS = st.lists(st.integers(0, 0xFFFF), min_size=1, max_size=8)


def reply(word: int) -> bytes:
    return b"\x03\x02" + struct.pack(">H", word)


def recorded_ctd(words: list[int], policy: EndOfRecording) -> tuple[SensorEmulator, End[bytes]]:
    """A ctd that is emulated from recorded exchanges, as `fieldtwin emulate RECORDING` serves them."""
    exchanges = [RecordedExchange(float(i), 1, READ_STATUS, reply(word), 0.01) for i, word in enumerate(words)]
    replay = ExchangeReplay(exchanges, when_used_up=policy)
    end, drivers_end = wire(RS232Connection)
    return SensorEmulator(end, CTD, replay.context, ReplayUnit(replay, 1).respond), drivers_end


# -- EmulatedConnection -------------------------------------------------------------------------------------------


def test_EmulatedConnection_is_a_Connection_of_type_TCP_for_its_whole_life() -> None:
    """Ruling 10."""
    connection = EmulatedConnection(PROTOCOL.RS232)
    assert isinstance(connection, TCPConnection)
    assert isinstance(connection, Connection)
    assert connection.type is PROTOCOL.TCP
    connection.emulate_write(b"1")
    connection.emulate_read(b"2")
    assert connection.type is PROTOCOL.TCP


@pytest.mark.parametrize("protocol", [PROTOCOL.RS232, PROTOCOL.TCP])
def test_EmulatedConnection_knows_the_original_protocol(protocol: PROTOCOL) -> None:
    assert EmulatedConnection(protocol).protocol is protocol


def test_EmulatedConnection_of_CAN_is_a_bus_and_none_of_these() -> None:
    """Ruling 13."""
    with pytest.raises(Bug, match="bus"):
        EmulatedConnection(PROTOCOL.CAN)


@given(chunks=st.lists(st.binary(max_size=8)))
def test_EmulatedConnection_EmulateWrite_and_EmulateRead_forward_byte_for_byte(chunks: list[bytes]) -> None:
    connection = EmulatedConnection(PROTOCOL.RS232)
    assert [connection.emulate_write(chunk) for chunk in chunks] == chunks
    assert [connection.emulate_read(chunk) for chunk in reversed(chunks)] == chunks[::-1]
    size = sum(map(len, chunks))
    assert (connection.written_bytes, connection.read_bytes) == (size, size)


@given(chunks=st.lists(st.binary(max_size=4)))
def test_EmulatedConnection_has_Read_and_Write_through_Connection(chunks: list[bytes]) -> None:
    """Ruling 10."""
    connection = EmulatedConnection(PROTOCOL.RS232)
    for chunk in chunks:
        connection.write(chunk)
    assert [connection.read() for _ in chunks] == chunks
    with pytest.raises(Bug, match="empty"):
        connection.read()


# -- Emulator -----------------------------------------------------------------------------------------------------


def test_Emulator_is_abstract_and_a_Device_and_not_a_Sensor() -> None:
    assert inspect.isabstract(Emulator)
    assert issubclass(Emulator, Device)
    assert issubclass(SensorEmulator, Emulator)
    assert not issubclass(Emulator, Sensor)
    assert not issubclass(SensorEmulator, Sensor)


@given(words=WORDS)
def test_Emulator_virtualContext_is_a_collection_of_RECORDINGs(words: list[int]) -> None:
    emulator, _ = recorded_ctd(words, EndOfRecording.ERROR)
    context = emulator.virtual_context
    assert isinstance(context, VirtualContext)
    assert len(context) == 2 * len(words)  # each exchange: the result of the request, and the register read
    for command in context.command_list:
        assert isinstance(context.take(command), RECORDING)


def test_Emulator_virtualContext_of_the_running_ctd_is_its_recorded_cast() -> None:
    """Ruling 3: signals are read at the emulator's clock; they are recordings nevertheless."""
    from fieldtwin.emulators.signals import SignalTrack

    prototype = observatory()[1]
    recording = prototype.devices["ctd"].recording
    assert recording is not None
    assert len(SignalTrack.load(recording)) > 1000


def test_SensorEmulator_is_on_RS232() -> None:
    assert SensorEmulator.wire_types == {PROTOCOL.RS232}


def test_SensorEmulator_ExecuteCommand_requires_the_command_to_be_in_the_list() -> None:
    emulator, _ = recorded_ctd([1, 2], EndOfRecording.ERROR)
    assert isinstance(emulator.virtual_context, VirtualContext)
    before = len(emulator.virtual_context)
    for command in (COMMAND(READ_STATUS, "melt_down"), COMMAND(READ_STATUS)):
        with pytest.raises(UnknownCommand):
            emulator.execute_command(command, 0)
    assert len(emulator.virtual_context) == before
    assert not emulator.executed


@given(words=WORDS)
def test_SensorEmulator_ExecuteCommand_returns_one_of_the_context_and_removes_it(words: list[int]) -> None:
    """Ruling 3: in recorded order; duplicates are two."""
    emulator, drivers_end = recorded_ctd(words, EndOfRecording.ERROR)
    assert isinstance(emulator.virtual_context, VirtualContext)
    for done, word in enumerate(words):
        assert len(emulator.virtual_context) == 2 * (len(words) - done)
        drivers_end.write(READ_STATUS)
        response = emulator.receive(0)
        assert isinstance(response, RECORDING)
        assert response.data == drivers_end.read() == reply(word)
    assert len(emulator.virtual_context) == 0
    assert emulator.executed == {"read_status": len(words)}


@pytest.mark.parametrize(
    ("policy", "then"),
    [
        (EndOfRecording.HOLD, [reply(3), reply(3)]),
        (EndOfRecording.LOOP, [reply(1), reply(2)]),
        (EndOfRecording.ERROR, [b"\x83\x04"] * 2),
    ],
)
def test_SensorEmulator_when_the_context_is_used_up_does_what_the_prototype_file_says(
    policy: EndOfRecording, then: list[bytes]
) -> None:
    """Ruling 3: hold, loop or error."""
    emulator, drivers_end = recorded_ctd([1, 2, 3], policy)
    for _ in range(5):
        drivers_end.write(READ_STATUS)
        emulator.receive(0)
    answers = [drivers_end.read() for _ in range(5)]
    assert answers == [reply(1), reply(2), reply(3), *then]


@given(words=WORDS, extra=st.integers(0, 4))
def test_SensorEmulator_context_is_bounded_ordered_and_counts_what_it_drops(words: list[int], extra: int) -> None:
    """Ruling 2."""
    command = COMMAND(READ_STATUS, "read_status")
    room = max(1, len(words) - extra)
    context = VirtualContext([command], when_used_up=EndOfRecording.ERROR, max_entries=room)
    for i, word in enumerate(words):
        context.add(command, Recorded(float(i), RECORDING(reply(word))))
    assert context.dropped == len(words) - len(context) == max(0, len(words) - room)
    assert [context.take(command).data for _ in range(len(context))] == [reply(word) for word in words[-room:]]
    with pytest.raises(UsedUp):
        context.take(command)
