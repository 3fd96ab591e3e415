"""A pair of modems with mailboxes in holding registers, and the link between them (paper.md, ruling 17).

Each modem has its own register bank on its own socket: one for the plant, one for the remote side. A message that one side writes
into its outbox travels over the link and appears in the inbox of the opposite side when that inbox is free. A repeated sequence
number is treated as the same message and not sent twice. A modem runs no task: it is brought up to the present time whenever
its registers are read or written.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from random import Random

from fieldtwin.emulators.codec import encode
from fieldtwin.emulators.journal import DeviceValueLog
from fieldtwin.emulators.modbus.bank import CellSpan, IllegalValue, MapBank, RegisterBank, Table
from fieldtwin.emulators.models.modbus.packet_link import TAME, LinkImpairments, PacketLink, PacketSink, PacketSource
from fieldtwin.emulators.stated import bytes_of, cells_held
from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.gateway.core.files.profile import Box, DeviceProfile, RegisterRange, Tag

LAST_SEQUENCE = 0xFFFF
RECEIVED = 64
"""The number of messages that may wait for a free inbox. Further messages wait in the link."""


_LINK = "link_state", "link_sent", "link_received", "link_resent"


class MailboxModem(RegisterBank):
    """One modem.

    `outgoing` carries what it sends, `incoming` what it receives; `identity` gives the values of its other tags.
    """

    def __init__(
        self,
        profile: DeviceProfile,
        outgoing: PacketSource,
        incoming: PacketSink,
        identity: Mapping[str, str] | None = None,
    ) -> None:
        if profile.inbox is None or profile.outbox is None:
            raise FileInvalid("the profile has no mailbox", path=profile.path, expected="`mailbox:`")
        self._inbox, self._outbox = profile.inbox, profile.outbox
        self.journal = DeviceValueLog()
        self._outgoing, self._incoming = outgoing, incoming
        self._tags = profile.tags
        self._cells = MapBank(_spans(profile), self._on_write)
        self._written_counters = (-1, -1, -1, -1)
        """The link's counters as last written to its registers (`_LINK`); -1 before the first write."""
        self._received: deque[bytes] = deque(maxlen=RECEIVED)
        self._sequence = 0
        self._accepted = 0
        self._pending: bytes | None = None
        for name, text in (identity or {}).items():
            self._state(name, text)
        for tag in self._tags.values():  # tags without an identity are read as empty or 0
            if tag.readable and tag.name not in (identity or {}):
                self._note(tag, 0)

    def _note(self, tag: Tag, now_ns: int) -> None:
        """Add the present value of the registers of `tag` to the journal."""
        self.journal.note(tag.name, bytes_of(tag, cells_held(tag, self._cells.peek)), now_ns)

    def _state(self, name: str, text: str) -> None:
        """Write the value `text` of a tag that never changes into the registers of the tag."""
        tag = self._tags[name]
        try:
            words = encode(text if tag.is_text else float(text), tag.type, tag.order, registers=tag.registers.count)
        except ValueError as e:
            raise FileInvalid(f"{name!r} is a number", expected="such as 1", got=text) from e
        self._cells.poke(tag.registers.table, tag.registers.address, *words)
        self.journal.note(name, bytes_of(tag, words), 0)

    def read(self, table: Table, address: int, count: int, now_ns: int) -> Sequence[int]:
        self.advance(now_ns)
        return self._cells.read(table, address, count, now_ns)

    def check_read(self, table: Table, address: int, count: int, now_ns: int) -> None:
        self._cells.check_read(table, address, count, now_ns)

    def peek(self, table: Table, address: int) -> int:
        """Return the value of a cell without the side effects of a read."""
        return self._cells.peek(table, address)

    def write(self, table: Table, address: int, values: Sequence[int], now_ns: int) -> None:
        self.advance(now_ns)
        self._cells.write(table, address, values, now_ns)
        if table == self._outbox.at.table and address == self._outbox.at.address:
            self._take_outbox()
        self.advance(now_ns)

    def advance(self, now_ns: int) -> None:
        """Pass a pending message to the link, take received messages, fill a free inbox, and refresh the counters."""
        if self._pending is not None and self._outgoing.submit(self._pending, now_ns):
            self._pending = None
            self._poke(self._outbox.ack, self._accepted)
        while len(self._received) < RECEIVED and (payload := self._incoming.arrived(now_ns)) is not None:
            self._received.append(payload)
        if self._received and self._cells.peek("holding", self._inbox.ack.address) == self._sequence:
            self._fill_inbox(self._received.popleft())
        counters = 1, self._outgoing.sent, self._incoming.delivered, self._outgoing.resent
        if counters != self._written_counters:
            self._tell(counters, now_ns)

    def _tell(self, counters: tuple[int, int, int, int], now_ns: int) -> None:
        """Write the link's changed counters into their registers."""
        before, self._written_counters = self._written_counters, counters
        for name, number, told in zip(_LINK, counters, before, strict=True):
            tag = self._tags.get(name)
            if tag is not None and number != told:
                words = encode(number, tag.type, tag.order)
                self._cells.poke(tag.registers.table, tag.registers.address, *words)
                self.journal.note(name, bytes_of(tag, words), now_ns)

    def _on_write(self, table: Table, address: int, values: tuple[int, ...], now_ns: int) -> None:
        """Check that sequence, length and payload come in one write, from the outbox's first register."""
        box = self._outbox.at
        if table != box.table or not (address < box.end and address + len(values) > box.address):
            return
        if address != box.address or len(values) < 3 or not 0 < values[1] <= 2 * (len(values) - 2):
            raise IllegalValue("not a mailbox message", expected="sequence, length and payload in one write")
        if values[0] == 0 or values[1] > self._outbox.bytes:
            raise IllegalValue(
                "not a mailbox message", expected=f"sequence 1 to 65535, up to {self._outbox.bytes} bytes"
            )
        if self._pending is not None and values[0] != self._accepted:
            raise IllegalValue("the outbox is full", expected="wait until its message is acknowledged")

    def _take_outbox(self) -> None:
        at = self._outbox.at
        sequence, length = self._cells.peek("holding", at.address), self._cells.peek("holding", at.address + 1)
        if sequence == self._accepted:
            return  # the client sends the same message again, because it did not receive the reply
        first = at.address + 2
        words = [self._cells.peek("holding", a) for a in range(first, first + (length + 1) // 2)]
        self._accepted = sequence
        self._pending = b"".join(w.to_bytes(2) for w in words)[:length]

    def _fill_inbox(self, payload: bytes) -> None:
        self._sequence = 1 if self._sequence >= LAST_SEQUENCE else self._sequence + 1
        padded = payload.ljust(2 * ((self._inbox.bytes + 1) // 2), b"\0")
        words = [self._sequence, len(payload)]
        words += [int.from_bytes(padded[i : i + 2]) for i in range(0, len(padded), 2)]
        self._cells.poke("holding", self._inbox.at.address, *words)

    def _poke(self, at: RegisterRange, value: int) -> None:
        self._cells.poke(at.table, at.address, value)


class ModemPair:
    """Both modems and both directions of the link. `latency_s` is the latency of one direction."""

    def __init__(
        self,
        profile: DeviceProfile,
        *,
        bytes_per_s: float,
        latency_s: float,
        loss: float,
        seed: int,
        untamed: LinkImpairments = TAME,
        identity: Mapping[str, str] | None = None,
    ) -> None:
        up = PacketLink(bytes_per_s, latency_s, loss, Random(f"{seed} up"), untamed=untamed)
        down = PacketLink(bytes_per_s, latency_s, loss, Random(f"{seed} down"), untamed=untamed)
        self.near = MailboxModem(profile, up, down, identity)
        self.far = MailboxModem(profile, down, up)
        self.up, self.down = up, down


def _spans(profile: DeviceProfile) -> list[CellSpan]:
    """Return the cells of the mailboxes and of the tags.

    The device writes the inbox and the outbox's acknowledge register; the client writes the outbox and the inbox's
    acknowledge register.
    """

    def box(b: Box, message: str, ack: str) -> list[CellSpan]:
        return [
            CellSpan("holding", b.at.address, b.at.count, "ro" if message == "ro" else "rw"),
            CellSpan("holding", b.ack.address, 1, "ro" if ack == "ro" else "rw"),
        ]

    assert profile.inbox is not None
    assert profile.outbox is not None
    spans = box(profile.inbox, "ro", "rw") + box(profile.outbox, "rw", "ro")
    return spans + [
        CellSpan(t.registers.table, t.registers.address, t.registers.count, "ro") for t in profile.tags.values()
    ]
