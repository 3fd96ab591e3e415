"""An acoustic channel: one medium that all modems share, each at its own position.

Sound reaches all modems within range, at its speed, so a packet is received later at a larger distance. A modem that transmits
receives nothing (half duplex), two packets that overlap at a receiver are both lost, and others are lost at random. A modem sends
its next packet only when it neither transmits nor receives. There are no acknowledgements and no retransmissions; the users of
the modems must handle losses.

The model runs no task: at each access it computes the events up to that time in their order, and the same seed gives the same
losses. It does not depend on modem registers or sockets, and does not interpret packets.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from heapq import heappop, heappush
from math import dist
from random import Random

from fieldtwin.gateway.core.clock import NS_PER_MS, NS_PER_S
from fieldtwin.gateway.core.errors import UsageError

QUEUE = 4
"""The number of packets that may wait in a modem to be sent. The modem refuses further packets."""
MAX_RECEIVED = 64
"""The number of received packets that may wait in a modem until they are taken. If more arrive, the oldest are dropped and
counted.
"""
PAUSE_NS = 200 * NS_PER_MS
"""The longest additional random wait of a modem that could not transmit."""


@dataclass(frozen=True, slots=True)
class AcousticProperties:
    """Properties of the medium that all packets share.

    `overhead_bytes` are preamble, addresses and checksum of each packet. `loss` is the share of the packets that each receiver
    loses at random.
    """

    range_m: float
    sound_m_per_s: float = 1500.0
    bytes_per_s: float = 80.0
    overhead_bytes: int = 8
    loss: float = 0.0

    def airtime_ns(self, payload: bytes) -> int:
        """Return the transmission time of a packet with `payload`."""
        return round((len(payload) + self.overhead_bytes) / self.bytes_per_s * NS_PER_S)


@dataclass(slots=True)
class Reception:
    """A packet as one modem receives it, from `begins_ns` to `ends_ns`. `spoilt` is the reason for its loss; empty if none."""

    payload: bytes
    begins_ns: int
    ends_ns: int
    spoilt: str = ""


Spoils = Callable[[int, int, bytes], bool]
"""A function ``spoils(t_ns, listener, payload)`` that returns whether a fault removes the packet at the receiver with the
number `listener` (from 1).
"""

LOSSES = ("collision", "speaking", "chance", "fault")


@dataclass(slots=True)
class ModemCounters:
    """Counters of one modem.

    `lost` counts lost packets by cause: ``collision``, ``speaking`` (the modem itself transmitted), ``chance``, ``fault``.
    """

    said: int = 0
    heard: int = 0
    dropped: int = 0
    lost: dict[str, int] = field(default_factory=lambda: dict.fromkeys(LOSSES, 0))

    def as_dict(self) -> dict[str, int]:
        return {"said": self.said, "heard": self.heard, "dropped": self.dropped, **self.lost}


class _Modem:
    def __init__(self, number: int, at_m: tuple[float, ...], random: Random) -> None:
        self.number = number
        self.at_m = at_m
        self.random = random
        self.counters = ModemCounters()
        self.to_send: deque[tuple[int, bytes]] = deque()
        """Packets that wait to be sent, each with the earliest time of its transmission."""
        self.heard: deque[bytes] = deque()
        self.receptions: list[Reception] = []
        """Packets that are arriving at this modem or will arrive later."""
        self.speaks_until_ns = 0
        self.spoke_from_ns = 0
        self.due_ns: int | None = None
        """The time at which the modem next tries to transmit."""


class AcousticMedium:
    """The shared medium.

    `places` gives the position of each modem in metres, in two or three dimensions. `spoils` applies the faults, if any.
    """

    def __init__(
        self,
        water: AcousticProperties,
        places: Mapping[str, tuple[float, ...]],
        seed: int,
        spoils: Spoils | None = None,
    ) -> None:
        self.water = water
        self.spoils = spoils
        self.on_send: Callable[[], None] | None = None
        """A function that is called when a modem has a packet to send, because `next_ns` may have changed."""
        self._modems = {
            name: _Modem(number, at_m, Random(f"{seed} {name}"))
            for number, (name, at_m) in enumerate(places.items(), 1)
        }
        self._events: list[tuple[int, int, _Modem, Reception | None]] = []
        """A heap of events: the time, a sequence number, the modem, and the reception that ends, or None if the modem tries to
        transmit.
        """
        self._number = 0

    @property
    def counters(self) -> dict[str, ModemCounters]:
        return {name: modem.counters for name, modem in self._modems.items()}

    @property
    def next_ns(self) -> int | None:
        """Return the time of the next event (ns); None if nothing happens until a modem sends."""
        return self._events[0][0] if self._events else None

    def neighbours(self, name: str) -> list[str]:
        """Return the modems within range of `name`."""
        here = self._modem(name)
        return [n for n, other in self._modems.items() if other is not here and self._way_m(here, other) is not None]

    def transmit(self, name: str, payload: bytes, now_ns: int, *, times: int = 1, every_ns: int = 0) -> bool:
        """Queue `payload` at `name`, to be sent `times` times. Return False if the modem's queue is full."""
        self.advance(now_ns)
        modem = self._modem(name)
        if len(modem.to_send) >= QUEUE:
            return False
        for n in range(times):
            modem.to_send.append((now_ns + n * every_ns, payload))
        self._try(modem, now_ns)
        self.advance(now_ns)
        if self.on_send is not None:
            self.on_send()
        return True

    def take(self, name: str, now_ns: int) -> bytes | None:
        """Return the next packet that `name` has received completely by `now_ns`, or None."""
        self.advance(now_ns)
        heard = self._modem(name).heard
        return heard.popleft() if heard else None

    def advance(self, now_ns: int) -> None:
        """Compute all events until `now_ns`."""
        while self._events and self._events[0][0] <= now_ns:
            t_ns, _, modem, reception = heappop(self._events)
            if reception is not None:
                self._heard(modem, reception, t_ns)
            elif modem.due_ns == t_ns:
                modem.due_ns = None
                self._speak(modem, t_ns)

    # -- transmitting ---------------------------------------------------------------------------------------------------

    def _try(self, modem: _Modem, t_ns: int) -> None:
        """Schedule the modem's next attempt to transmit at `t_ns`, or later if its next packet may not be sent then.

        A modem has at most one pending attempt."""
        if modem.to_send:
            t_ns = max(t_ns, modem.to_send[0][0])
            if modem.due_ns is None or t_ns < modem.due_ns:
                modem.due_ns = t_ns
                self._at(t_ns, modem, None)

    def _speak(self, modem: _Modem, t_ns: int) -> None:
        hears_until_ns = max((r.ends_ns for r in modem.receptions if r.begins_ns <= t_ns < r.ends_ns), default=t_ns)
        busy_until_ns = max(hears_until_ns, modem.speaks_until_ns)
        if busy_until_ns > t_ns:
            self._try(modem, busy_until_ns + modem.random.randrange(PAUSE_NS))
            return
        _, payload = modem.to_send.popleft()
        modem.counters.said += 1
        ends_ns = t_ns + self.water.airtime_ns(payload)
        modem.spoke_from_ns, modem.speaks_until_ns = t_ns, ends_ns
        for reception in modem.receptions:  # packets that arrive while the modem transmits are lost
            if reception.begins_ns < ends_ns:
                reception.spoilt = reception.spoilt or "speaking"
        for other in self._modems.values():
            way_m = None if other is modem else self._way_m(modem, other)
            if way_m is not None:
                self._sound(other, payload, t_ns, way_m)
        self._try(modem, ends_ns + modem.random.randrange(PAUSE_NS))

    def _sound(self, listener: _Modem, payload: bytes, t_ns: int, way_m: float) -> None:
        begins_ns = t_ns + round(way_m / self.water.sound_m_per_s * NS_PER_S)
        new = Reception(payload, begins_ns, begins_ns + self.water.airtime_ns(payload))
        for old in listener.receptions:
            if old.begins_ns < new.ends_ns and new.begins_ns < old.ends_ns:
                old.spoilt, new.spoilt = old.spoilt or "collision", "collision"
        if listener.spoke_from_ns < new.ends_ns and begins_ns < listener.speaks_until_ns:
            new.spoilt = new.spoilt or "speaking"
        listener.receptions.append(new)
        self._at(new.ends_ns, listener, new)

    # -- receiving ------------------------------------------------------------------------------------------------------

    def _heard(self, modem: _Modem, reception: Reception, t_ns: int) -> None:
        modem.receptions.remove(reception)
        missed = modem.random.random() < self.water.loss
        why = reception.spoilt or ("chance" if missed else "")
        if not why and self.spoils is not None and self.spoils(t_ns, modem.number, reception.payload):
            why = "fault"
        if why:
            modem.counters.lost[why] += 1
            return
        modem.counters.heard += 1
        if len(modem.heard) >= MAX_RECEIVED:
            modem.heard.popleft()
            modem.counters.dropped += 1
        modem.heard.append(reception.payload)

    # -- helpers --------------------------------------------------------------------------------------------------------

    def _at(self, t_ns: int, modem: _Modem, reception: Reception | None) -> None:
        self._number += 1
        heappush(self._events, (t_ns, self._number, modem, reception))

    def _way_m(self, one: _Modem, other: _Modem) -> float | None:
        """Return the distance between two modems in metres; None if they are out of range."""
        way_m = dist(one.at_m, other.at_m)
        return way_m if way_m <= self.water.range_m else None

    def _modem(self, name: str) -> _Modem:
        if name not in self._modems:
            raise UsageError(f"no modem {name!r} on the acoustic channel", expected=", ".join(self._modems))
        return self._modems[name]
