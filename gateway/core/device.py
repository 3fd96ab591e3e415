"""The paper's Device, and the wire between it and its driver (SPEC rows Device, Sensor, Transmitter; ruling 4).

A wire is a duplex medium with two ends: what one end writes, the other reads, first in first out. A device holds one end,
its driver the other. Pure: no bytes are waited for, nothing is opened. The asynchronous ends of gateway.core.connection wrap the
same `Connection` streams.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable
from typing import ClassVar

from gateway.core.connection import PROTOCOL, Connection, RS232Connection, TCPConnection
from gateway.core.errors import Bug, UnknownCommand
from gateway.core.values import COMMAND, RESPONSE


class WireEnd:
    """One end of a wire: reads from one stream, writes to the other."""

    def __init__(self, inbound: Connection[bytes], outbound: Connection[bytes]) -> None:
        if type(inbound) is not type(outbound):
            raise Bug("a wire of two kinds", expected=inbound.type.value, got=outbound.type.value)
        self._inbound = inbound
        self._outbound = outbound

    @property
    def type(self) -> PROTOCOL:
        return self._inbound.type

    @property
    def pending(self) -> int:
        """How many items wait to be read here."""
        return len(self._inbound.data_stream)

    def read(self) -> bytes:
        """The oldest item that the other end wrote. There must be one."""
        return self._inbound.read()

    def write(self, data: bytes) -> None:
        """Append to what the other end reads."""
        self._outbound.write(data)


def wire(kind: type[Connection[bytes]]) -> tuple[WireEnd, WireEnd]:
    """A new, empty wire of one kind: (the device's end, the driver's end)."""
    to_device, to_driver = kind(), kind()
    return WireEnd(to_device, to_driver), WireEnd(to_driver, to_device)


class Device(ABC):
    """SPEC row Device: owns one concrete connection; accepts the commands in its list, and there is at least one.

    A concrete device says in `wire_types` what it can be connected by. A command is known by its bits.
    """

    wire_types: ClassVar[frozenset[PROTOCOL]] = frozenset(PROTOCOL)

    def __init__(self, connection: WireEnd, command_list: Iterable[COMMAND]) -> None:
        self.connection = connection
        self.command_list = tuple(command_list)
        if not self.command_list:
            raise Bug("a device without commands", where=type(self).__name__)
        if connection.type not in self.wire_types:
            expected = " or ".join(sorted(t.value for t in self.wire_types))
            raise Bug("a device on a wire of another kind", expected=expected, got=connection.type.value)

    def execute_command(self, command: COMMAND) -> RESPONSE:
        """Execute a command of the list; raises `UnknownCommand` for any other."""
        if all(command.data != known.data for known in self.command_list):
            raise UnknownCommand("not in the command list", got=command.data.hex(" ") or "no bytes")
        return self._execute(command)

    @abstractmethod
    def _execute(self, command: COMMAND) -> RESPONSE:
        """What the device does with a command that is in its list."""

    def send(self, response: RESPONSE) -> None:
        """Send: connection.Write."""
        self.connection.write(response.data)

    def receive(self) -> None:
        """Receive: connection.Read ; ExecuteCommand ; Send. One response for each command."""
        self.send(self.execute_command(COMMAND(self.connection.read())))


class Sensor(Device, ABC):
    """A device on RS232 (SPEC row Sensor)."""

    wire_types = frozenset({RS232Connection.type})


class Transmitter(Device, ABC):
    """A device on TCP (SPEC row Transmitter)."""

    wire_types = frozenset({TCPConnection.type})
