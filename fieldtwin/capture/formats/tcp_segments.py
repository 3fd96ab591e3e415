"""Extract the bytes of conversations from packets: link layer, IP, UDP, and TCP reassembled.

`Conversations` is fed packets and calls back with the payload of each TCP or UDP conversation, in the order of sending;
`Segments` reassembles one direction of a TCP stream. Sans-IO; the number of conversations and the bytes that wait for a
missing segment are bounded. The module must never depend on the payload's protocol.

Sources: RFC 791, 8200, 768, 9293; link types: https://www.tcpdump.org/linktypes.html.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable
from dataclasses import dataclass, field

from fieldtwin.capture.formats.ip_fragments import Fragments

LINK_NULL, LINK_ETHERNET, LINK_RAW, LINK_LOOP, LINK_SLL, LINK_SLL2 = 0, 1, 101, 108, 113, 276
_RAW = (12, 14, LINK_RAW, 228, 229)
_VLAN = (0x8100, 0x88A8, 0x9100)
_IP4, _IP6 = 0x0800, 0x86DD
_TCP, _UDP = 6, 17
_SEQUENCES = 1 << 32
_PLAIN_IP4 = b"\x08\x00\x45"
"""The EtherType of IPv4, followed by the first byte of an IPv4 header without options."""

MAX_WAITING = 64
"""Maximum number of segments that wait for an earlier one; beyond it the capture counts as having lost the earlier one."""
MAX_WAITING_BYTES = 65_536
MAX_CONVERSATIONS = 1024

Side = tuple[bytes, int]
"""One side of a conversation: IP address (4 or 16 bytes) and port."""


class Segments:
    """One direction of a TCP stream. `lost` counts bytes that the capture does not have."""

    __slots__ = ("_waiting", "lost", "next")

    @property
    def waits(self) -> bool:
        """Return whether data after a gap has arrived."""
        return bool(self._waiting)

    def __init__(self) -> None:
        self.next = -1
        self.lost = 0
        self._waiting: dict[int, bytes] = {}

    def add(self, sequence: int, data: bytes) -> list[tuple[int, bytes]]:
        """Return the available data: (bytes lost just before, bytes), in order. Repeated bytes are returned once."""
        if self.next < 0 or sequence == self.next:
            self.next = (sequence + len(data)) % _SEQUENCES
            return [(0, data)] if not self._waiting else [(0, data), *self._follow()]
        ahead = (sequence - self.next) % _SEQUENCES
        if ahead >= _SEQUENCES // 2:  # a retransmission: only the part after `next` is new
            new = data[_SEQUENCES - ahead :]
            if not new:
                return []
            self.next = (self.next + len(new)) % _SEQUENCES
            return [(0, new), *self._follow()]
        if len(data) > len(self._waiting.get(sequence, b"")):
            self._waiting[sequence] = data
        full = len(self._waiting) > MAX_WAITING or sum(map(len, self._waiting.values())) > MAX_WAITING_BYTES
        return self._give_up() if full else []

    def acknowledged(self, number: int) -> list[tuple[int, bytes]]:
        """Note that the receiver has all data before `number`; return the available data, as `add`. A gap before `number`
        exists only in the capture, so it will not be filled.
        """
        found: list[tuple[int, bytes]] = []
        while self._waiting and 0 < (number - self.next) % _SEQUENCES < _SEQUENCES // 2:
            found += self._give_up()
        return found

    def flush(self) -> list[tuple[int, bytes]]:
        """Return the remaining data at the end of the stream; gaps will not be filled."""
        found = []
        while self._waiting:
            found += self._give_up()
        return found

    def _follow(self) -> list[tuple[int, bytes]]:
        found = []
        while self._waiting:
            data = self._waiting.pop(self.next, None)
            if data is None:
                begun = next((s for s in self._waiting if (s - self.next) % _SEQUENCES >= _SEQUENCES // 2), None)
                if begun is None:
                    break
                data = self._waiting.pop(begun)[(self.next - begun) % _SEQUENCES :]
            if data:
                found.append((0, data))
                self.next = (self.next + len(data)) % _SEQUENCES
        return found

    def _give_up(self) -> list[tuple[int, bytes]]:
        nearest = min(self._waiting, key=lambda s: (s - self.next) % _SEQUENCES)
        missing = (nearest - self.next) % _SEQUENCES
        self.lost += missing
        data = self._waiting.pop(nearest)
        self.next = (nearest + len(data)) % _SEQUENCES
        return [(missing, data), *self._follow()]


@dataclass(slots=True)
class Conversation:
    """A conversation of two sides over TCP or UDP. `client` is the side that opened it (None if the capture does not show
    that).
    """

    udp: bool
    sides: tuple[Side, Side]
    client: Side | None = None
    segments: dict[Side, Segments] = field(default_factory=dict)
    last_ns: int = 0
    ended: bool = False
    state: object = None
    """An object of the caller that belongs to this conversation; this module does not use it."""


OnData = Callable[[Conversation, Side, bytes, int, int], None]
"""Called with (conversation, the sending side, bytes, time in ns, number of bytes lost just before)."""
OnEnd = Callable[[Conversation], None]


@dataclass(slots=True)
class PacketCounters:
    """The counts of packets. `carried` had a payload; `fragments` are IP packets of which a fragment is missing."""

    packets: int = 0
    carried: int = 0
    others: int = 0
    cut_short: int = 0
    fragments: int = 0
    lost_bytes: int = 0


@dataclass(frozen=True, slots=True)
class _Path:
    """One direction of a connection, found by the addresses and ports of its packets."""

    conversation: Conversation
    sender: Side
    mine: Segments
    theirs: Segments


class Conversations:
    """All conversations of a capture. A connection that is opened again with the same ports is a new conversation."""

    def __init__(self, on_data: OnData, on_end: OnEnd) -> None:
        self.counters = PacketCounters()
        self._on_data, self._on_end = on_data, on_end
        self._open: dict[tuple[bool, Side, Side], Conversation] = {}
        self._fragments = Fragments()
        self._paths: dict[bytes, _Path] = {}

    def packet(self, t_ns: int, link: int, data: bytes) -> None:
        """Add the next packet of the capture."""
        self.counters.packets += 1
        if link == LINK_ETHERNET and len(data) >= 54 and data[12:15] == _PLAIN_IP4 and data[23] == _TCP:
            if not self._next_segment(t_ns, data):
                self._ip4(t_ns, data, 14)
                self._remember(data)
            return
        found = _network(link, data)
        if found is None:
            self.counters.others += 1
            return
        protocol, at = found
        if protocol == _IP4:
            self._ip4(t_ns, data, at)
        elif protocol == _IP6:
            self._ip6(t_ns, data, at)
        else:
            self.counters.others += 1

    def _next_segment(self, t_ns: int, data: bytes) -> bool:
        """Handle the next segment of a known connection without gaps, which saves a fifth of an import's time.

        Return False in any other case.
        """
        path = self._paths.get(data[26:38])
        if (
            path is None
            or path.conversation.ended
            or data[47] & 0x07
            or data[20] & 0x3F
            or data[21]
            or path.theirs.waits
        ):
            return False
        end = 14 + (data[16] << 8 | data[17])
        payload = data[34 + (data[46] >> 4) * 4 : end]
        if not payload or end > len(data) or end == 14:
            return not payload and 14 < end <= len(data)
        mine = path.mine
        if mine.waits or int.from_bytes(data[38:42]) != mine.next:
            return False
        mine.next = (mine.next + len(payload)) % _SEQUENCES
        self.counters.carried += 1
        path.conversation.last_ns = t_ns
        self._on_data(path.conversation, path.sender, payload, t_ns, 0)
        return True

    def _remember(self, data: bytes) -> None:
        """Store the connection of the following packets, once both sides were seen."""
        sender, other = (data[26:30], data[34] << 8 | data[35]), (data[30:34], data[36] << 8 | data[37])
        conversation = self._open.get(_key(False, sender, other))
        if conversation is not None and len(conversation.segments) == 2:
            if len(self._paths) >= 2 * MAX_CONVERSATIONS:
                self._paths.clear()
            segments = conversation.segments
            self._paths[data[26:38]] = _Path(conversation, sender, segments[sender], segments[other])

    def finish(self) -> None:
        """End the capture: pass on the data that still wait for a missing segment."""
        self._fragments.finish()
        self.counters.fragments = self._fragments.given_up
        for key in list(self._open):
            self._end(key)

    def _ip4(self, t_ns: int, data: bytes, at: int) -> None:
        if len(data) < at + 20 or data[at] >> 4 != 4:
            self.counters.cut_short += 1
            return
        head, total = (data[at] & 15) * 4, data[at + 2] << 8 | data[at + 3]
        end = at + total if total else len(data)  # 0: the network card divides the packet later
        if (data[at + 6] & 0x3F) | data[at + 7]:
            place = data[at + 6] << 8 | data[at + 7]
            key = data[at + 12 : at + 20], data[at + 9], data[at + 4 : at + 6]
            self._piece(t_ns, key, (place & 0x1FFF) * 8, bool(place & 0x2000), data[at + head : end], key[0], key[1])
            return
        self._transport(t_ns, data[at + 9], data[at + 12 : at + 16], data[at + 16 : at + 20], data, at + head, end)

    def _ip6(self, t_ns: int, data: bytes, at: int) -> None:
        if len(data) < at + 40 or data[at] >> 4 != 6:
            self.counters.cut_short += 1
            return
        length, following = data[at + 4] << 8 | data[at + 5], data[at + 6]
        source, target = data[at + 8 : at + 24], data[at + 24 : at + 40]
        start, end = at + 40, at + 40 + length
        while following in (0, 43, 60) and start + 8 <= min(end, len(data)):  # options and routing, by 8 bytes
            following, start = data[start], start + 8 + data[start + 1] * 8
        if following == 44 and start + 8 <= len(data):
            place = data[start + 2] << 8 | data[start + 3]
            key = source + target, data[start + 4 : start + 8]
            body = data[start + 8 : end]
            self._piece(t_ns, key, place & 0xFFF8, bool(place & 1), body, source + target, data[start])
            return
        self._transport(t_ns, following, source, target, data, start, end)

    def _piece(
        self, t_ns: int, key: Hashable, offset: int, more: bool, data: bytes, addresses: bytes, protocol: int
    ) -> None:
        """Add a fragment of an IP packet; when the packet is complete, process its payload."""
        whole = self._fragments.add(key, offset, data, more=more)
        if whole is not None:
            half = len(addresses) // 2
            self._transport(t_ns, protocol, addresses[:half], addresses[half:], whole, 0, len(whole))

    def _transport(
        self, t_ns: int, protocol: int, source: bytes, target: bytes, data: bytes, at: int, end: int
    ) -> None:
        if protocol == _TCP:
            self._tcp(t_ns, source, target, data, at, end)
        elif protocol == _UDP and at + 8 <= min(end, len(data)):
            left, right = (source, data[at] << 8 | data[at + 1]), (target, data[at + 2] << 8 | data[at + 3])
            payload = data[at + 8 : end]
            if payload:
                self.counters.carried += 1
                self._on_data(self._conversation(True, left, right), left, payload, t_ns, 0)
        else:
            self.counters.others += 1

    def _tcp(self, t_ns: int, source: bytes, target: bytes, data: bytes, at: int, end: int) -> None:
        if at + 20 > len(data) or end < at + 20:
            self.counters.cut_short += 1
            return
        sender, other = (source, data[at] << 8 | data[at + 1]), (target, data[at + 2] << 8 | data[at + 3])
        flags, payload = data[at + 13], data[at + (data[at + 12] >> 4) * 4 : end]
        if flags & 0x10:
            self._acknowledged(sender, other, int.from_bytes(data[at + 8 : at + 12]), t_ns)
        if flags & 0x07 == 0x02:  # a SYN together with FIN or RST does not open a connection
            self._opened(sender, other, data[at + 4 : at + 8], acknowledged=bool(flags & 0x10))
            return
        if payload:
            conversation = self._conversation(False, sender, other)
            segments = conversation.segments.get(sender)
            if segments is None:
                segments = conversation.segments[sender] = Segments()
            self.counters.carried += 1
            conversation.last_ns = t_ns
            for lost, chunk in segments.add(int.from_bytes(data[at + 4 : at + 8]), payload):
                self.counters.lost_bytes += lost
                self._on_data(conversation, sender, chunk, t_ns, lost)
        if len(data) < end:
            self.counters.cut_short += 1
        if flags & 0x04:  # RST
            self._end(_key(False, sender, other))

    def _acknowledged(self, sender: Side, other: Side, number: int, t_ns: int) -> None:
        conversation = self._open.get(_key(False, sender, other))
        segments = conversation.segments.get(other) if conversation is not None else None
        if conversation is not None and segments is not None and segments.waits:
            for lost, chunk in segments.acknowledged(number):
                self.counters.lost_bytes += lost
                self._on_data(conversation, other, chunk, t_ns, lost)

    def _opened(self, sender: Side, other: Side, sequence: bytes, *, acknowledged: bool) -> None:
        key = _key(False, sender, other)
        number = (int.from_bytes(sequence) + 1) % _SEQUENCES
        there = self._open.get(key)
        if not acknowledged:
            if there is not None and (sender not in there.segments or there.segments[sender].next != number):
                self._end(key)
            there = self._conversation(False, sender, other)
            there.client = sender
        elif there is None:
            there = self._conversation(False, sender, other)
            there.client = other
        begins = there.segments.setdefault(sender, Segments())
        if begins.next < 0:
            begins.next = number

    def _conversation(self, udp: bool, left: Side, right: Side) -> Conversation:
        key = _key(udp, left, right)
        found = self._open.get(key)
        if found is None:
            if len(self._open) >= MAX_CONVERSATIONS:
                self._end(next(iter(self._open)))
            found = self._open[key] = Conversation(udp, (left, right))
        return found

    def _end(self, key: tuple[bool, Side, Side]) -> None:
        conversation = self._open.pop(key, None)
        if conversation is None:
            return
        conversation.ended = True
        for side, segments in conversation.segments.items():
            for lost, chunk in segments.flush():
                self.counters.lost_bytes += lost
                self._on_data(conversation, side, chunk, conversation.last_ns, lost)
        self._on_end(conversation)


def _key(udp: bool, left: Side, right: Side) -> tuple[bool, Side, Side]:
    return (udp, left, right) if left < right else (udp, right, left)


def _network(link: int, data: bytes) -> tuple[int, int] | None:
    """Return the network protocol (an EtherType) of a packet and its offset; None if the link layer states none."""
    if link == LINK_ETHERNET:
        kind, at = int.from_bytes(data[12:14]), 14
        while kind in _VLAN and at + 4 <= len(data):
            kind, at = int.from_bytes(data[at + 2 : at + 4]), at + 4
        return kind, at
    if link in _RAW:
        return ({4: _IP4, 6: _IP6}.get(data[0] >> 4, 0), 0) if data else None
    if link in (LINK_NULL, LINK_LOOP) and len(data) > 4:
        return {4: _IP4, 6: _IP6}.get(data[4] >> 4, 0), 4
    if link == LINK_SLL and len(data) >= 16:
        return int.from_bytes(data[14:16]), 16
    if link == LINK_SLL2 and len(data) >= 20:
        return int.from_bytes(data[:2]), 20
    return None
