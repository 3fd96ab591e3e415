"""A slow, lossy link between two modems that delivers every packet once and in order.

Packets are sent one after the other at `bytes_per_s`, arrive `latency_s` after their last byte, and are lost with probability
`loss`. The sender detects a loss by the missing acknowledgement and resends. Packets are therefore late but never lost, unless
the link is configured with `LinkImpairments`. The link uses a seeded random generator and runs no task: it computes the arrival
time of a packet when the packet is sent.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from random import Random
from typing import Protocol

from fieldtwin.gateway.core.clock import NS_PER_S

OVERHEAD_BYTES = 8
"""The number of bytes of a packet in addition to its payload: preamble, address and checksum."""
MAX_RESENDS = 50


class PacketSource(Protocol):
    """An object to which a modem gives packets for transmission."""

    sent: int
    resent: int

    def submit(self, payload: bytes, now_ns: int) -> bool:
        """Send `payload`; return False if the link has no room."""
        ...


class PacketSink(Protocol):
    """An object from which a modem takes received packets."""

    delivered: int

    def arrived(self, now_ns: int) -> bytes | None:
        """Return the next packet that has arrived by `now_ns` and remove it, or return None."""
        ...


class ModemEnd(PacketSource, PacketSink, Protocol):
    """Both directions of a link, for one modem."""


@dataclass(frozen=True, slots=True)
class LinkImpairments:
    """Faults of the link that the modems do not correct.

    Each field is a probability per packet: that it never arrives, arrives twice, or arrives before its predecessor.
    """

    lost: float = 0.0
    repeated: float = 0.0
    overtakes: float = 0.0


TAME = LinkImpairments()


class PacketLink:
    """One direction of a link. At most `capacity` packets are in transit; `submit` refuses more."""

    def __init__(
        self,
        bytes_per_s: float,
        latency_s: float,
        loss: float,
        random: Random,
        capacity: int = 8,
        untamed: LinkImpairments = TAME,
    ) -> None:
        self._bytes_per_s = bytes_per_s
        self._latency_ns = round(latency_s * NS_PER_S)
        self._loss = loss
        self._random = random
        self._capacity = capacity
        self._untamed = untamed
        self._under_way: deque[tuple[int, bytes]] = deque()
        self._free_ns = 0
        self.sent = self.resent = self.delivered = self.lost = 0

    @property
    def full(self) -> bool:
        return len(self._under_way) >= self._capacity

    def submit(self, payload: bytes, now_ns: int) -> bool:
        """Send `payload`; return False if the link has no room."""
        if self.full:
            return False
        airtime_ns = round((len(payload) + OVERHEAD_BYTES) / self._bytes_per_s * NS_PER_S)
        end_ns = max(now_ns, self._free_ns) + airtime_ns
        for _ in range(MAX_RESENDS):
            if self._random.random() >= self._loss:
                break
            self.resent += 1
            end_ns += 2 * self._latency_ns + airtime_ns
        self._free_ns = end_ns
        self.sent += 1
        self._launch(end_ns + self._latency_ns, payload)
        return True

    def _launch(self, arrives_ns: int, payload: bytes) -> None:
        if self._happens(self._untamed.lost):
            self.lost += 1
            return
        if self._under_way and self._happens(self._untamed.overtakes):
            before_ns, overtaken = self._under_way.pop()
            self._under_way.append((before_ns, payload))
            payload = overtaken
        self._under_way.append((arrives_ns, payload))
        if self._happens(self._untamed.repeated):
            self._under_way.append((arrives_ns, payload))

    def _happens(self, probability: float) -> bool:
        return probability > 0 and self._random.random() < probability

    def arrived(self, now_ns: int) -> bytes | None:
        """Return the next packet that has arrived by `now_ns` and remove it, or return None."""
        if self._under_way and self._under_way[0][0] <= now_ns:
            self.delivered += 1
            return self._under_way.popleft()[1]
        return None

    @property
    def waiting(self) -> bool:
        """Return whether a packet is in transit, or has arrived and was not taken."""
        return bool(self._under_way)
