"""A TCP or UDP conversation that may be Modbus: its client, its framing, and its exchanges.

Nothing is assumed except a port that the user named: the framing is found from the first bytes of either side, and the client
from the port, from the side that opened the connection, or from the first frame. A conversation that is not recognised as
Modbus is dropped after `MAX_UNDECIDED` bytes. Sans-IO.
"""

from __future__ import annotations

import ipaddress
from collections.abc import Collection

from fieldtwin.capture.decoding.modbus_frames import RtuSplitter
from fieldtwin.capture.formats.tcp_segments import Conversation, Side
from fieldtwin.capture.recordings.pairing import OnBad, Pairer, pairer
from fieldtwin.gateway.core.files.recording import RecordedExchange

MODBUS_PORTS = frozenset({502, 503, 802})
MAX_UNDECIDED = 600
"""Number of bytes after which a conversation that is not recognised as Modbus counts as a different protocol."""


class ModbusConversation:
    """One conversation. `server` is None until Modbus is recognised; `foreign` means that it is another protocol."""

    def __init__(
        self, conversation: Conversation, zero_ns: int, ports: Collection[int] = (), on_bad: OnBad | None = None
    ) -> None:
        self._conversation = conversation
        self._zero_ns, self._on_bad = zero_ns, on_bad
        self._ports = frozenset(ports)
        self.foreign = bool(self._ports) and not any(side[1] in self._ports for side in conversation.sides)
        self.framing = ""
        self.server: Side | None = None
        self.pairer: Pairer | None = None
        self._seen: list[tuple[Side, bytes, int]] = []
        self._undecided = 0

    def feed(self, side: Side, data: bytes, t_ns: int, lost: int) -> list[RecordedExchange]:
        """Add bytes from `side`, before which `lost` bytes are missing in the capture; return the exchanges that are now
        complete.
        """
        if self.pairer is not None:
            if lost:
                self.pairer.lost(side != self.server)
            return self.pairer.feed(side != self.server, data, t_ns)
        if self.foreign:
            return []
        self._seen.append((side, data, t_ns))
        self._undecided += len(data)
        self._decide()
        return self._catch_up()

    def finish(self) -> list[RecordedExchange]:
        """End the conversation; return its remaining exchanges."""
        if self.pairer is None and not self.foreign and self._seen and self._known_port:
            self._settle(self._framing_of_port())
            return [*self._catch_up(), *self.finish()]
        return self.pairer.finish() if self.pairer is not None else []

    @property
    def endpoint(self) -> str:
        """Return the server's URL, or that of the second side if no server was recognised."""
        scheme = {"mbap": "tcp", "rtu": "rtu+tcp"}.get(self.framing, self.framing or "tcp")
        address, port = self.server or self._conversation.sides[1]
        text = str(ipaddress.ip_address(address))
        return f"{scheme}://{f'[{text}]' if ':' in text else text}:{port}"

    @property
    def _known_port(self) -> bool:
        return any(side[1] in self._ports or side[1] in MODBUS_PORTS for side in self._conversation.sides)

    def _catch_up(self) -> list[RecordedExchange]:
        if self.pairer is None:
            return []
        seen, self._seen = self._seen, []
        return [e for side, data, t_ns in seen for e in self.pairer.feed(side != self.server, data, t_ns)]

    def _decide(self) -> None:
        """Recognise the framing and the client by the first bytes of each side. The bytes are joined, because a frame may
        arrive in parts.
        """
        for side in self._conversation.sides:
            data = b"".join(d for who, d, _ in self._seen if who == side)
            if len(data) >= 8 and is_mbap(data):
                self._settle("udp" if self._conversation.udp else "mbap")
                return
            if len(data) >= 4 and not self._conversation.udp and is_rtu(data):
                self._settle("rtu")
                return
        if self._undecided > MAX_UNDECIDED:
            if self._known_port:
                self._settle(self._framing_of_port())
            else:
                self.foreign = True
                self._seen.clear()

    def _framing_of_port(self) -> str:
        return "udp" if self._conversation.udp else "mbap"

    def _settle(self, framing: str) -> None:
        self.framing = framing
        self.server = self._find_server()
        self.pairer = pairer(framing, self._zero_ns, self._on_bad)

    def _find_server(self) -> Side:
        left, right = self._conversation.sides
        for ports in (self._ports, MODBUS_PORTS):
            known = [side for side in (left, right) if side[1] in ports]
            if len(known) == 1:
                return known[0]
        if self._conversation.client is not None:
            return right if self._conversation.client == left else left
        for side, data, _ in self._seen:
            if self.framing != "rtu" and (told := _asks(data)) is not None:
                return (right if side == left else left) if told else side
        first = self._seen[0][0]
        return right if first == left else left


def is_mbap(data: bytes) -> bool:
    """Return whether the bytes begin with a Modbus TCP frame: protocol ID 0, a length that fits a PDU, a valid function code."""
    size = data[4] << 8 | data[5]
    return (
        data[2:4] == b"\0\0" and 3 <= size <= 254 and 0 < data[7] & 0x7F < 0x70 and not (data[7] & 0x80 and size != 3)
    )


def is_rtu(data: bytes) -> bool:
    """Return whether the bytes contain an RTU frame with a correct check sum."""
    found = RtuSplitter()
    frames = [*found.feed(data[:MAX_UNDECIDED], 0), *found.flush()]
    return bool(frames) and not frames[0].bad and 0 < frames[0].pdu[0] & 0x7F < 0x70


def _asks(data: bytes) -> bool | None:
    """Return whether a Modbus TCP frame is a request for registers or bits; None if it may also be a reply."""
    if len(data) < 8 or data[7] & 0x80:
        return None if len(data) < 8 else False
    size = data[4] << 8 | data[5]
    if data[7] in (1, 2, 3, 4) and len(data) >= 9:
        reply = size == 3 + data[8]
        request = size == 6
        return None if reply == request else request
    return None
