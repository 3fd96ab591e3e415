"""The DeviceDriver of docs/explanation/paper.md: a driver with one concrete connection, an event emitter and an event consumer.

The operation Send takes a command from the consumer and writes it to the device; the operation Receive reads a message from the
device and emits it. A driver opens no connection: the runtime opens it through a Connector and attaches the driver. A driver
uses only the clock that it is given, and cannot distinguish an emulator from the device.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar, Protocol

from fieldtwin.gateway.core.concurrency.events import Consumer, Producer
from fieldtwin.gateway.core.connection import PROTOCOL, ByteConnection, CanConnection
from fieldtwin.gateway.core.errors import Bug, DeviceRefused, FileInvalid, NotAllowed, UnknownCommand
from fieldtwin.gateway.core.values import COMMAND, DATA, Reason, TagValue
from fieldtwin.gateway.devices.config import DeviceConfig


class TagSink(Protocol):
    """The interface to which a driver passes its values: the runtime's tag table."""

    def put(self, name: str, value: TagValue) -> None:
        """Store the newest value of the tag `name` (``device.tag``)."""
        ...

    def put_bad(self, names: list[str], reason: Reason) -> None:
        """Mark every tag of `names` as bad from now on; its last value and time stay readable."""
        ...


class DeviceDriver(ABC):
    """A driver of one device. Concrete classes list the kinds of connection they accept in `wire_types`."""

    wire_types: ClassVar[frozenset[PROTOCOL]]

    def __init__(self, config: DeviceConfig, sink: TagSink) -> None:
        self.config = config
        self.profile = config.profile
        self.sink = sink
        self.emitter: Producer[DATA] = Producer(f"{config.name}.received")
        self.consumer: Consumer[DATA] = Consumer(f"{config.name}.to_send", capacity=64)
        self.identity_error: str = ""
        self._connection: ByteConnection | CanConnection | None = None

    @property
    def command_list(self) -> frozenset[str]:
        """Return the commands that this driver can send: those of its profile, and those that a class in `quirks` adds."""
        return self.profile.command_list

    @property
    def connection(self) -> ByteConnection | CanConnection:
        """Return the connection that this driver is attached to."""
        if self._connection is None:
            raise Bug("a driver without a connection was used", where=self.config.where)
        return self._connection

    @property
    def tag_names(self) -> list[str]:
        """Return the full names of all tags that this driver publishes."""
        return [f"{self.config.name}.{t.name}" for t in self.profile.tags.values() if t.readable]

    def attach(self, connection: ByteConnection | CanConnection) -> None:
        """Use this connection from now on (Init). Items that were not sent over an earlier connection stay queued."""
        if connection.inbound.type not in self.wire_types:
            raise FileInvalid(
                f"device {self.config.name!r} does not fit this bus",
                path=self.profile.path,
                expected=" or ".join(sorted(t.value for t in self.wire_types)),
                got=connection.inbound.type.value,
            )
        self._connection = connection

    def reconfigure(self, config: DeviceConfig) -> None:
        """Use `config` from now on.

        It describes the same device at the same address, with different limits, scaling or timing. Must not be called during a
        read or write.
        """
        self.config, self.profile = config, config.profile

    def check(self, command: COMMAND) -> None:
        """Raise `UnknownCommand` unless `command` is in the command list."""
        if command.name not in self.command_list:
            raise UnknownCommand(
                f"no command {command.name!r}", expected=", ".join(sorted(self.command_list)), where=self.config.where
            )

    def command(self, tag_name: str, value: float) -> COMMAND:
        """Return the command that writes `value` (engineering units) to a tag. Raises `NotAllowed` for a tag that
        cannot be written, or a value outside its limits."""
        raise NotAllowed(f"the tag {tag_name!r} cannot be written", where=self.config.where)

    def behaviour(self, name: str) -> tuple[COMMAND, ...]:
        """Return the commands that the profile maps to a named behaviour, in the profile's order (paper.md, ruling 14).

        Raises `NotAllowed` for a name that the profile does not have, and otherwise as `command`.
        """
        form = self.profile.form
        if name not in form.behaviours:
            known = ", ".join(form.behaviours) or "none"
            raise NotAllowed(f"no behaviour {name!r}", expected=known, where=self.config.where)
        return tuple(self.command(form.commands[command], value) for command, value in form.behaviours[name].items())

    def change_behaviour(self, name: str) -> int:
        """Queue all commands of a behaviour and return their number (ChangeBehavior).

        Raises as `behaviour`; no command is queued then.
        """
        commands = self.behaviour(name)
        for command in commands:
            self.consumer.observe(command)
        return len(commands)

    async def send(self) -> None:
        """Take one item from the consumer's queue and write it to the device (Send). The queue must not be empty.

        An item that the device or the configuration refused is dropped. After a communication error, the item stays first in the
        queue.
        """
        item = self.consumer.consume()
        try:
            await self._write(item)
        except (DeviceRefused, NotAllowed):
            raise
        except BaseException:  # a cancelled write may or may not have arrived, so it is sent again under the same name
            self.consumer.put_back(item)
            raise

    async def receive(self, what: str) -> None:
        """Read from the device and emit the data that has to be passed on, such as messages (Receive).

        `what` is a poll group, or another name that the driver can read.
        """
        for item in await self._read(what):
            self.emitter.emit(item)

    @abstractmethod
    async def _write(self, item: DATA) -> None:
        """Write the consumed item to the device. Raises communication errors or errors of the device."""

    @abstractmethod
    async def _read(self, what: str) -> list[DATA]:
        """Read `what` from the device, publish the tag values, and return the data to emit, in order."""
