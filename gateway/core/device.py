"""The Device of docs/explanation/paper.md, and the check that a device and its driver have equal command lists.

A device holds one end of a link of a concrete kind, has a command list, and answers each command that it reads with one
response. It uses no I/O, no clock (it is passed `now_ns`) and no framing: an item of its connection is a whole message. This
module does not know drivers; they are in fieldtwin.gateway.devices.driver.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import ClassVar, Generic

from fieldtwin.gateway.core.connection import PROTOCOL, Connection, T
from fieldtwin.gateway.core.errors import Bug, CommandListMismatch, UnknownCommand
from fieldtwin.gateway.core.values import COMMAND, RESPONSE


class End(Generic[T]):
    """One end of a duplex medium. Reading returns what the other end wrote, in order (paper.md, ruling 4)."""

    __slots__ = ("inbound", "outbound", "read", "type", "write")

    def __init__(self, inbound: Connection[T], outbound: Connection[T]) -> None:
        self.inbound: Connection[T] = inbound
        self.outbound: Connection[T] = outbound
        self.type = inbound.type
        self.write: Callable[[T], None] = outbound.write
        """A function that sends an item to the other end."""
        self.read: Callable[[], T] = inbound.read
        """A function that takes the oldest item that the other end sent. There must be one."""


def wire(kind: type[Connection[T]]) -> tuple[End[T], End[T]]:
    """Return both ends of a new duplex link, which consists of two streams of a concrete kind, one for each direction."""
    there, back = kind(), kind()
    return End(there, back), End(back, there)


class Device(ABC):
    """The paper's Device. Concrete classes list in `wire_types` the kinds of link to which they may be connected.

    `command_list` holds the names of the device's commands and is never empty.
    """

    wire_types: ClassVar[frozenset[PROTOCOL]]

    def __init__(self, connection: End[bytes], command_list: Iterable[str]) -> None:
        commands = frozenset(command_list)
        kind = type(self).__name__
        if connection.type not in self.wire_types:
            expected = " or ".join(sorted(t.value for t in self.wire_types))
            raise Bug(f"a {kind} on a different kind of connection", expected=expected, got=connection.type.value)
        if not commands:
            raise Bug(f"a {kind} that accepts no command", expected="a command list that is not empty")
        self.connection = connection
        self.command_list = commands

    @abstractmethod
    def recognise(self, data: bytes) -> COMMAND:
        """Return the command that a message contains. Its name is empty if the device does not know the message."""

    @abstractmethod
    def _execute(self, command: COMMAND, now_ns: int) -> RESPONSE:
        """Carry out a command of the command list and return the response."""

    def execute_command(self, command: COMMAND, now_ns: int) -> RESPONSE:
        """Execute `command` and return the response (ExecuteCommand).

        Raises `UnknownCommand` and does nothing if the command is not in the command list.
        """
        if command.name not in self.command_list:
            raise UnknownCommand(
                f"no command {command.name!r}" if command.name else "a message that is not a command",
                expected=", ".join(sorted(self.command_list)),
                got=command.data.hex(" ") or "no bytes",
            )
        return self._execute(command, now_ns)

    def send(self, response: RESPONSE) -> None:
        """Write the response to the connection (Send)."""
        self.connection.write(response.data)

    def receive(self, now_ns: int) -> RESPONSE:
        """Read a message, execute it and send the response (Receive). A message that is not a command is not answered.

        The connection must not be empty. Raises `UnknownCommand`; the protocol defines how the device then reacts (paper.md,
        ruling 11).
        """
        command = self.recognise(self.connection.read())
        response = self.execute_command(command, now_ns)
        self.send(response)
        return response


class Sensor(Device):
    """The paper's Sensor: a device on RS232."""

    wire_types = frozenset({PROTOCOL.RS232})


class Transmitter(Device):
    """The paper's Transmitter: a device on TCP."""

    wire_types = frozenset({PROTOCOL.TCP})


@dataclass(frozen=True)
class Communication:
    """The paper's Communication: a driver and a device whose command lists are equal (paper.md, ruling 12)."""

    name: str
    driver_commands: frozenset[str]
    device_commands: frozenset[str]

    def check(self) -> None:
        """Raise `CommandListMismatch`, with the commands that only one list contains, unless the lists are equal."""
        if self.driver_commands == self.device_commands:
            return
        only_driver = ", ".join(sorted(self.driver_commands - self.device_commands)) or "nothing"
        only_device = ", ".join(sorted(self.device_commands - self.driver_commands)) or "nothing"
        raise CommandListMismatch(
            f"device {self.name!r} and its driver differ in their commands",
            expected="the same list on both sides",
            got=f"unknown to the device: {only_driver}; unknown to the driver: {only_device}",
        )
