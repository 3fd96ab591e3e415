"""Schemas Device, Sensor, Transmitter, on the emulated units of the field simulator, which are our Devices."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from spec_rig import CLOCK, observatory, rig
from support import run

from fieldtwin.emulators.emulator import Emulator, SensorEmulator, TransmitterEmulator, UnitEmulator, emulator_kind
from fieldtwin.emulators.modbus.bank import CellSpan, MapBank
from fieldtwin.emulators.modbus.unit import ModbusUnit
from fieldtwin.gateway.core.connection import PROTOCOL, CANConnection, Connection, RS232Connection, TCPConnection
from fieldtwin.gateway.core.device import Device, End, Sensor, Transmitter, wire
from fieldtwin.gateway.core.errors import Bug, UnknownCommand
from fieldtwin.gateway.core.files.profile_file import load_profile, resolve
from fieldtwin.gateway.core.files.yaml_file import parse
from fieldtwin.gateway.core.values import COMMAND, RESPONSE

SYSTEM, _ = observatory()
CTD, MODEM = SYSTEM.devices["ctd"].profile, SYSTEM.devices["modem"].profile
READ_VALUES = bytes.fromhex("04 0000 000A")
SET_PERIOD = bytes.fromhex("10 0001 0001 02 0005")
NO_COMMAND = bytes.fromhex("04 1000 0001")


def ctd_device() -> tuple[SensorEmulator, End[bytes], ModbusUnit]:
    """The ctd over plain registers, the driver's end of its wire, and the unit that serves it."""
    bank = MapBank([CellSpan("input", 0, 10), CellSpan("holding", 0, 2), CellSpan("holding", 100, 4)])
    unit = ModbusUnit(bank)
    end, drivers_end = wire(RS232Connection)
    return SensorEmulator(end, CTD, (), unit.respond), drivers_end, unit


class Thermometer(Sensor):
    """A sensor as a user with hardware would write it: the paper's Sensor is abstract in its operations."""

    def recognise(self, data: bytes) -> COMMAND:
        return COMMAND(data, "read" if data == b"?" else "")

    def _execute(self, command: COMMAND, now_ns: int) -> RESPONSE:
        return RESPONSE(b"21.5")


class Modem(Transmitter):
    """The same for a transmitter."""

    recognise = Thermometer.recognise
    _execute = Thermometer._execute


@pytest.mark.parametrize("kind", [Device, Sensor, Transmitter, Emulator])
def test_Device_is_abstract(kind: type[Device]) -> None:
    with pytest.raises(TypeError, match="abstract"):
        kind(wire(RS232Connection)[0], ["read"])


def test_Device_owns_a_concrete_connection_and_never_the_abstract_class() -> None:
    with pytest.raises(Bug, match="abstract"):
        wire(Connection)
    device, _, _ = ctd_device()
    assert type(device.connection.inbound) is RS232Connection
    assert type(device.connection.outbound) is RS232Connection


def test_Device_command_list_is_not_empty() -> None:
    with pytest.raises(Bug, match="accepts no command"):
        Thermometer(wire(RS232Connection)[0], [])
    text = "device: x/y\nsource: nowhere\nprotocol: modbus\nnumbering: printed\ntags: {}\n"
    mute = resolve(parse(text, "mute.yaml"))
    with pytest.raises(Bug, match="accepts no command"):
        SensorEmulator(wire(RS232Connection)[0], mute, (), lambda pdu, now_ns: None)


@given(name=st.text(max_size=12).filter(lambda n: n not in CTD.command_list))
def test_Device_ExecuteCommand_requires_the_command_to_be_in_the_list(name: str) -> None:
    device, drivers_end, unit = ctd_device()
    with pytest.raises(UnknownCommand):
        device.execute_command(COMMAND(SET_PERIOD, name), 0)
    assert unit.counters.requests == 0  # no effect
    with pytest.raises(Bug):
        drivers_end.read()


def test_Device_ExecuteCommand_executes_a_command_of_the_list() -> None:
    device, _, unit = ctd_device()
    assert device.execute_command(COMMAND(SET_PERIOD, "set_period"), 0).data == SET_PERIOD[:5]
    assert list(unit.bank.read("holding", 1, 1, 0)) == [5]


@given(requests=st.lists(st.sampled_from([READ_VALUES, SET_PERIOD]), max_size=8))
def test_Device_Receive_is_Read_ExecuteCommand_Send_with_one_response_per_command(requests: list[bytes]) -> None:
    device, drivers_end, unit = ctd_device()
    for request in requests:
        drivers_end.write(request)
    sent = [device.receive(0) for _ in requests]
    assert all(isinstance(response, RESPONSE) for response in sent)
    assert [drivers_end.read() for _ in requests] == [response.data for response in sent]
    assert unit.counters.requests == len(requests)
    for nothing_left in (device.connection, drivers_end):
        with pytest.raises(Bug):
            nothing_left.read()


def test_Device_Receive_of_data_that_is_not_a_command_answers_nothing() -> None:
    """Ruling 11: the wire then carries the protocol's own answer, made by the unit and not by the device."""
    device, drivers_end, _ = ctd_device()
    drivers_end.write(NO_COMMAND)
    with pytest.raises(UnknownCommand):
        device.receive(0)
    for end in (device.connection, drivers_end):
        with pytest.raises(Bug):
            end.read()


def test_Device_is_what_a_running_line_asks(tmp_path: Path) -> None:
    async def main() -> None:
        async with rig(tmp_path) as r:
            unit, driver = r.unit("ctd"), r.register_driver("ctd")
            assert unit.emulator.command_list == driver.command_list
            await driver.receive("values")
            assert unit.emulator.executed == {"read_values": 1}
            driver.consumer.observe(driver.command("sample_period_s", 0))
            await driver.send()
            assert unit.emulator.executed["set_period"] == 1
            before = unit.counters.replies
            assert unit.respond(NO_COMMAND, CLOCK.monotonic_ns()) == bytes([0x84, 0x02])
            assert (unit.unlisted, unit.counters.replies) == (1, before + 1)

    run(main())


@pytest.mark.parametrize("kind", [TCPConnection, CANConnection])
def test_Sensor_hangs_on_RS232_only(kind: type[Connection[bytes]]) -> None:
    assert Thermometer(wire(RS232Connection)[0], ["read"]).connection.type is PROTOCOL.RS232
    with pytest.raises(Bug, match="different kind of connection"):
        Thermometer(wire(kind)[0], ["read"])
    with pytest.raises(Bug, match="different kind of connection"):
        SensorEmulator(wire(kind)[0], CTD, (), lambda pdu, now_ns: None)


def test_Sensor_result_of_a_command_is_a_RESPONSE() -> None:
    device, _, _ = ctd_device()
    assert isinstance(device.execute_command(device.recognise(READ_VALUES), 0), RESPONSE)
    hardware = Thermometer(wire(RS232Connection)[0], ["read"])
    assert isinstance(hardware.execute_command(COMMAND(b"?", "read"), 0), RESPONSE)


@pytest.mark.parametrize("kind", [RS232Connection, CANConnection])
def test_Transmitter_hangs_on_TCP_only(kind: type[Connection[bytes]]) -> None:
    assert Modem(wire(TCPConnection)[0], ["read"]).connection.type is PROTOCOL.TCP
    with pytest.raises(Bug, match="different kind of connection"):
        Modem(wire(kind)[0], ["read"])
    with pytest.raises(Bug, match="different kind of connection"):
        TransmitterEmulator(wire(kind)[0], MODEM, (), lambda pdu, now_ns: None)


def test_Transmitter_result_of_a_command_is_a_RESPONSE(tmp_path: Path) -> None:
    async def main() -> None:
        async with rig(tmp_path) as r:
            emulator = r.unit("modem").emulator
            assert isinstance(emulator, TransmitterEmulator)
            result = emulator.execute_command(emulator.recognise(bytes.fromhex("03 0000 0022")), CLOCK.monotonic_ns())
            assert isinstance(result, RESPONSE)
            assert result.data[:2] == bytes([3, 0x44])

    run(main())


def test_Transmitter_is_recognised_by_its_mailbox() -> None:
    assert emulator_kind(PROTOCOL.TCP, MODEM) is TransmitterEmulator
    assert emulator_kind(PROTOCOL.RS232, CTD) is SensorEmulator
    assert emulator_kind(PROTOCOL.TCP, CTD) is UnitEmulator
    sdm = load_profile(Path(CTD.path).with_name("eastron-sdm630.yaml"))
    assert emulator_kind(PROTOCOL.RS232, sdm) is SensorEmulator
