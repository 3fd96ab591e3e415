"""The emulators of docs/explanation/paper.md: devices that answer from their virtual context, not from a physical environment.

An emulator is a Device and not a Sensor, because the real device is a black box of which only the communication is known. This
module lies between the frames of a line (fieldtwin.emulators.modbus.rtu.line, mbap) and the processing of a request by a unit
(fieldtwin.emulators.modbus.unit, fieldtwin.emulators.replay). An emulator reads a command from its own end of a connection,
checks that its command list contains it, answers from its context and sends the response. It does not depend on the driver.
"""

from __future__ import annotations

from abc import ABC
from collections import Counter
from collections.abc import Callable, Sized
from dataclasses import dataclass
from functools import lru_cache

from fieldtwin.emulators.command_names import CommandNames
from fieldtwin.emulators.modbus.bank import RegisterBank
from fieldtwin.emulators.modbus.unit import ModbusUnit, UnitLimits, UnitParts
from fieldtwin.gateway.core.connection import PROTOCOL, Connection
from fieldtwin.gateway.core.device import Communication, Device, End, wire
from fieldtwin.gateway.core.errors import UnknownCommand
from fieldtwin.gateway.core.files.profile import DeviceProfile
from fieldtwin.gateway.core.values import COMMAND, RECORDING

Answer = Callable[[bytes, int], bytes | None]
"""A function ``(request, now_ns) -> response`` by which a unit answers a request PDU; None if the unit sends no reply."""


class Emulator(Device, ABC):
    """An emulated device (the paper's schema Emulator). `virtual_context` is a collection of recordings, empty if a simulation
    replaces it.

    Recorded responses are returned in order and removed (`fieldtwin.emulators.context.VirtualContext`). Recorded
    signals are read at the time of the emulator's clock and are not removed (docs/explanation/paper.md, ruling 3).
    """

    def __init__(self, connection: End[bytes], profile: DeviceProfile, virtual_context: Sized) -> None:
        super().__init__(connection, profile.command_list)
        self.virtual_context = virtual_context
        self.executed: Counter[str] = Counter()
        """By command of the list: the number of times that it was executed."""


class UnitEmulator(Emulator):
    """The emulator of a Modbus device: messages are request and response PDUs. An empty response means that no reply is sent."""

    wire_types = frozenset({PROTOCOL.RS232, PROTOCOL.TCP})

    def __init__(self, connection: End[bytes], profile: DeviceProfile, virtual_context: Sized, answer: Answer) -> None:
        super().__init__(connection, profile, virtual_context)
        names = CommandNames(profile)
        self._recognised = lru_cache(maxsize=256)(lambda data: COMMAND(data, names.of(data)))
        self._answer = answer

    def recognise(self, data: bytes) -> COMMAND:
        return self._recognised(data)  # cached: saves 9 % of a virtual run that polls each 100 ms

    def _execute(self, command: COMMAND, now_ns: int) -> RECORDING:
        self.executed[command.name] += 1
        return RECORDING(self._answer(command.data, now_ns) or b"")


class SensorEmulator(UnitEmulator):
    """The paper's SensorEmulator: an emulator on RS232, like the sensor that it emulates."""

    wire_types = frozenset({PROTOCOL.RS232})


class TransmitterEmulator(UnitEmulator):
    """The emulator of a transmitter, on TCP."""

    wire_types = frozenset({PROTOCOL.TCP})


def emulator_kind(kind: PROTOCOL, profile: DeviceProfile) -> type[UnitEmulator]:
    """Return the emulator class for a profile on a kind of connection; the counterpart of the gateway's choice of drivers."""
    if profile.inbox is not None:
        return TransmitterEmulator
    return SensorEmulator if kind is PROTOCOL.RS232 else UnitEmulator


class EmulatedUnit(ModbusUnit):
    """A unit of an emulated line whose requests pass through the device's own connection.

    `kind` is the connection type of the real device, even if the emulated connection uses a different medium. A request that is
    not in the command list gets the answer that the protocol requires (docs/explanation/paper.md, ruling 11), and is counted in
    `unlisted`.
    """

    def __init__(
        self,
        bank: RegisterBank,
        profile: DeviceProfile,
        kind: type[Connection[bytes]],
        virtual_context: Sized,
        limits: UnitLimits | None = None,
        name: str = "",
        parts: UnitParts | None = None,
    ) -> None:
        super().__init__(bank, limits, name=name, **(parts or UnitParts()))
        end, self._line = wire(kind)
        self.emulator = emulator_kind(end.type, profile)(end, profile, virtual_context, super().respond)
        self.unlisted = 0

    def respond(self, pdu: bytes, now_ns: int) -> bytes | None:
        self._line.write(pdu)
        try:
            self.emulator.receive(now_ns)
        except UnknownCommand:
            self.unlisted += 1
            return super().respond(pdu, now_ns)
        return self._line.read() or None


@dataclass(frozen=True)
class EmulatedCommunication(Communication):
    """A driver and an emulator whose command lists are equal (the paper's schema EmulatedCommunication).

    The connection between the two is an EmulatedConnection (`fieldtwin.emulators.link`), which belongs to neither and
    is not used here.
    """
