"""The TransmitterDriver of docs/explanation/paper.md (ruling 17): it passes messages between two mailboxes and two queues.

A mailbox holds one message: sequence, length and payload, in holding registers that are written with one request. The sequence
that the receiver acknowledges is in a separate register. 0 means empty; sequences run from 1 to 65535 and then start again at 1.
A message whose sequence equals the acknowledged one is a duplicate and is discarded. A command that is sent twice has two
sequences and counts as two commands.

The topside controller and the plant both use this class. In the plant, the driver receives COMMANDs and sends RESPONSEs; topside,
it does the reverse. Payloads are never interpreted.
"""

from __future__ import annotations

import struct

from fieldtwin.gateway.core.connection import PROTOCOL
from fieldtwin.gateway.core.errors import Desync, FileInvalid, NotAllowed
from fieldtwin.gateway.core.files.profile import Box
from fieldtwin.gateway.core.values import COMMAND, DATA
from fieldtwin.gateway.devices.config import DeviceConfig
from fieldtwin.gateway.devices.driver import TagSink
from fieldtwin.gateway.devices.register_device import GroupReading, RegisterDriver

LAST_SEQUENCE = 0xFFFF
_SEQUENCE_AND_LENGTH = struct.Struct(">HH").unpack_from


def next_sequence(sequence: int) -> int:
    """Return the sequence after `sequence`. 0 is never used, because it means an empty mailbox."""
    return 1 if sequence >= LAST_SEQUENCE else sequence + 1


class TransmitterDriver(RegisterDriver):
    """A driver of a transmitter on TCP.

    `receive("inbox")` reads the inbox and emits its message if it is new; `acknowledge()` frees the inbox. `send()`
    writes the next queued message; it may be called when `outbox_free`, which `check_outbox()` updates.
    """

    wire_types = frozenset({PROTOCOL.TCP})

    def __init__(self, config: DeviceConfig, sink: TagSink, incoming: type[DATA] = COMMAND) -> None:
        super().__init__(config, sink)
        if self.profile.inbox is None or self.profile.outbox is None:
            raise FileInvalid("a transmitter's profile needs its mailbox", path=self.profile.path)
        self._inbox: Box = self.profile.inbox
        self._outbox: Box = self.profile.outbox
        self._incoming = incoming
        self._seen = 0
        self.emitted = b""
        """The whole inbox as it was when its message was emitted."""
        self.taken_before = b""
        """The whole inbox with a message that an earlier run of the gateway took, and perhaps did not acknowledge."""
        self._unconfirmed: tuple[int, DATA] | None = None
        """The sequence and the data of the message that was written, until the device confirms it; then None."""
        self._sent = 0
        self.to_acknowledge = 0
        """The sequence of the message that was emitted and is not acknowledged yet; 0 if there is none."""
        self.outbox_free = False
        self.outbox_tag = f"{self.config.name}.outbox"
        """The full name of the tag through which the control logic sends messages with this transmitter."""
        self.received = self.sent = self.taken = self.mailbox_waits = 0

    @property
    def message_tag(self) -> str:
        return f"{self.config.name}.inbox"

    async def synchronise(self) -> None:
        """Read from the device which messages each side has taken, so that no message is handled twice. Call it after each
        (re)connection.

        An emitted message that is not acknowledged yet keeps that state, and so does a message that was taken before. A message
        that was written, but whose reply was lost, counts as sent.
        """
        unit, inbox = self.config.address, self._inbox.at
        held = await self.client.read_registers(unit, "holding", inbox.address, inbox.count)
        inbox_ack = await self._word(self._inbox.ack.address)
        self._sent = await self._word(self._outbox.at.address)
        outbox_ack = await self._word(self._outbox.ack.address)
        if self.taken_before and held.raw == self.taken_before:
            self.emitted, self.to_acknowledge = held.raw, held.registers[0]
        self.taken_before = b""
        emitted = bool(self.to_acknowledge) and held.raw == self.emitted
        self._seen = held.registers[0] if emitted else inbox_ack
        self.to_acknowledge = self._seen if self._seen != inbox_ack else 0
        self.outbox_free = self._sent == outbox_ack
        if self._unconfirmed is not None and self._sent == self._unconfirmed[0]:
            if self.consumer.queue and self.consumer.queue[0] == self._unconfirmed[1]:
                self.consumer.consume()
            self.sent += 1
        self._unconfirmed = None

    async def _word(self, address: int) -> int:
        reply = await self.client.read_registers(self.config.address, "holding", address, 1)
        return reply.registers[0]

    def begin(self, what: str) -> GroupReading:
        return GroupReading(what) if what == "inbox" else super().begin(what)

    async def read_next(self, reading: GroupReading) -> bool:
        if reading.what != "inbox":
            return await super().read_next(reading)
        reading.items = await self._read_inbox()
        return True

    async def _read_inbox(self) -> list[DATA]:
        box = self._inbox
        reply = await self.client.read_registers(self.config.address, "holding", box.at.address, box.at.count)
        sequence, length = _SEQUENCE_AND_LENGTH(reply.raw)
        if sequence in (0, self._seen):
            return []
        if not 0 < length <= box.bytes:
            raise Desync(
                "an inbox message with an impossible length",
                expected=f"1 to {box.bytes} bytes",
                got=str(length),
                where=f"{self.config.where} {box.at}",
            )
        self._seen = self.to_acknowledge = sequence
        self.emitted = reply.raw
        self.received += 1
        return [self._incoming(reply.raw[4 : 4 + length])]

    async def acknowledge(self) -> None:
        """Acknowledge the emitted message to the transmitter; its mailbox is then free for the next message."""
        if self.to_acknowledge:
            await self.client.write_registers(self.config.address, self._inbox.ack.address, [self.to_acknowledge])
            self.to_acknowledge = 0

    async def check_outbox(self) -> bool:
        """Return whether the transmitter took the last message. If its mailbox is still full, increment `mailbox_waits`."""
        reply = await self.client.read_registers(self.config.address, "holding", self._outbox.ack.address, 1)
        free = reply.registers[0] == self._sent
        self.taken += free and not self.outbox_free
        self.mailbox_waits += not free
        self.outbox_free = free
        return free

    async def _write(self, item: DATA) -> None:
        box = self._outbox
        if not 0 < len(item.data) <= box.bytes:
            raise NotAllowed(
                "a message does not fit the outbox",
                expected=f"1 to {box.bytes} bytes",
                got=f"{len(item.data)} bytes",
                where=self.config.where,
            )
        sequence = next_sequence(self._sent)
        padded = item.data + b"\0" * (len(item.data) % 2)
        words = [sequence, len(item.data)]
        words += [int.from_bytes(padded[i : i + 2]) for i in range(0, len(padded), 2)]
        self._unconfirmed = (sequence, item)
        await self.client.write_registers(self.config.address, box.at.address, words)
        self._unconfirmed = None
        self._sent = sequence
        self.outbox_free = False
        self.sent += 1
