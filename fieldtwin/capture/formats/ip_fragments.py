"""Reassemble fragmented IP packets (RFC 791 3.2, RFC 8200 4.5), in bounded memory and without knowledge of the payload."""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass, field

MAX_PACKETS = 64
"""Maximum number of incomplete packets; beyond it the oldest is dropped."""
MAX_BYTES = 65_535
MAX_PIECES = 64


@dataclass(slots=True)
class _Packet:
    pieces: dict[int, bytes] = field(default_factory=dict)
    size: int = -1


class Fragments:
    """A reassembly of packets from fragments.

    `given_up` counts packets that were dropped because a fragment is missing or because they are invalid.
    """

    def __init__(self) -> None:
        self.given_up = 0
        self._open: dict[Hashable, _Packet] = {}

    def add(self, key: Hashable, offset: int, data: bytes, *, more: bool) -> bytes | None:
        """Add a fragment of the packet `key` (addresses, protocol, identification). Return the payload if the packet is
        complete now.
        """
        packet = self._open.get(key)
        if packet is None:
            if len(self._open) >= MAX_PACKETS:
                del self._open[next(iter(self._open))]
                self.given_up += 1
            packet = self._open[key] = _Packet()
        packet.pieces.setdefault(offset, data)
        if not more:
            packet.size = offset + len(data)
        if offset + len(data) > MAX_BYTES or len(packet.pieces) > MAX_PIECES:
            del self._open[key]
            self.given_up += 1
            return None
        return self._whole(key, packet)

    def finish(self) -> None:
        """Drop the incomplete packets at the end of the capture."""
        self.given_up += len(self._open)
        self._open.clear()

    def _whole(self, key: Hashable, packet: _Packet) -> bytes | None:
        if packet.size < 0:
            return None
        found = bytearray()
        for offset, data in sorted(packet.pieces.items()):
            if offset > len(found):
                return None
            found[offset:] = data if offset + len(data) > len(found) else found[offset:]
        if len(found) < packet.size:
            return None
        del self._open[key]
        return bytes(found[: packet.size])
