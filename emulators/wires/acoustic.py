"""Water that modems speak through: one acoustic medium, every modem in it at a place of its own.

Sound goes to whoever is near enough, at its speed, so a packet is heard later the farther away. A modem that speaks hears
nothing (half duplex), two packets that are heard at once are both lost, and others are lost by chance. A modem that has something
to say waits while it speaks or hears. Nothing is acknowledged and nothing sent again: that is for whoever speaks to care for.

A function of time: what happens is worked out in its order when somebody looks, and the same seed gives the same losses. It knows
no modem's registers, no sockets, and nothing of what is said.
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
"""Packets that wait in a modem to be said; it takes no more."""
HEARD = 64
"""Packets that were heard and not taken yet; the oldest are dropped, counted."""
PAUSE_NS = 200 * NS_PER_MS
"""How long a modem waits at most, besides, when it was kept from speaking."""


@dataclass(frozen=True, slots=True)
class Water:
    """What all packets of a medium have in common. `overhead_bytes`: preamble, addresses and check sum of each. `loss`: the
    share of the packets that each listener misses by chance."""

    range_m: float
    sound_m_per_s: float = 1500.0
    bytes_per_s: float = 80.0
    overhead_bytes: int = 8
    loss: float = 0.0

    def airtime_ns(self, payload: bytes) -> int:
        """How long a packet with `payload` sounds."""
        return round((len(payload) + self.overhead_bytes) / self.bytes_per_s * NS_PER_S)


@dataclass(slots=True)
class Reception:
    """A packet as one modem hears it, from `begins_ns` to `ends_ns`. `spoilt`: why it is lost, if it is."""

    payload: bytes
    begins_ns: int
    ends_ns: int
    spoilt: str = ""


Spoils = Callable[[int, int, bytes], bool]
"""``spoils(t_ns, listener, payload)``: whether a fault takes a packet from the listener with that number (from 1)."""

LOSSES = ("collision", "speaking", "chance", "fault")


@dataclass(slots=True)
class Counters:
    """Of one modem. `lost` by cause: ``collision``, ``speaking`` (it spoke itself), ``chance``, ``fault``."""

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
        self.counters = Counters()
        self.to_say: deque[tuple[int, bytes]] = deque()
        """What waits, each with the time before which it is not said."""
        self.heard: deque[bytes] = deque()
        self.hearing: list[Reception] = []
        """What sounds here now or is on its way."""
        self.speaks_until_ns = 0
        self.spoke_from_ns = 0
        self.due_ns: int | None = None
        """When it tries to speak next."""


class AcousticMedium:
    """`places`: where each modem is, in metres, in two or three dimensions. `spoils`: the faults that are in, if any."""

    def __init__(
        self, water: Water, places: Mapping[str, tuple[float, ...]], seed: int, spoils: Spoils | None = None
    ) -> None:
        self.water = water
        self.spoils = spoils
        self.on_say: Callable[[], None] | None = None
        """Told that something begins in the water, by whoever speaks: `next_ns` is another one."""
        self._modems = {
            name: _Modem(number, at_m, Random(f"{seed} {name}"))
            for number, (name, at_m) in enumerate(places.items(), 1)
        }
        self._events: list[tuple[int, int, _Modem, Reception | None]] = []
        """When, a running number, whose; the end of a reception, or None: the modem tries to speak."""
        self._number = 0

    @property
    def counters(self) -> dict[str, Counters]:
        return {name: modem.counters for name, modem in self._modems.items()}

    @property
    def next_ns(self) -> int | None:
        """When something happens next; None: nothing until somebody speaks."""
        return self._events[0][0] if self._events else None

    def neighbours(self, name: str) -> list[str]:
        """Who hears `name`."""
        here = self._modem(name)
        return [n for n, other in self._modems.items() if other is not here and self._way_m(here, other) is not None]

    def say(self, name: str, payload: bytes, now_ns: int, *, times: int = 1, every_ns: int = 0) -> bool:
        """`name` shall say `payload`, so often; False while as much waits as it takes."""
        self.advance(now_ns)
        modem = self._modem(name)
        if len(modem.to_say) >= QUEUE:
            return False
        for n in range(times):
            modem.to_say.append((now_ns + n * every_ns, payload))
        self._try(modem, now_ns)
        self.advance(now_ns)
        if self.on_say is not None:
            self.on_say()
        return True

    def take(self, name: str, now_ns: int) -> bytes | None:
        """The next packet that `name` has heard whole by `now_ns`, or None."""
        self.advance(now_ns)
        heard = self._modem(name).heard
        return heard.popleft() if heard else None

    def advance(self, now_ns: int) -> None:
        """Work out what happened until `now_ns`."""
        while self._events and self._events[0][0] <= now_ns:
            t_ns, _, modem, reception = heappop(self._events)
            if reception is not None:
                self._heard(modem, reception, t_ns)
            elif modem.due_ns == t_ns:
                modem.due_ns = None
                self._speak(modem, t_ns)

    # -- speaking -------------------------------------------------------------------------------------------------------

    def _try(self, modem: _Modem, t_ns: int) -> None:
        """Let the modem try at `t_ns`, or when its next packet may be said; once at a time."""
        if modem.to_say:
            t_ns = max(t_ns, modem.to_say[0][0])
            if modem.due_ns is None or t_ns < modem.due_ns:
                modem.due_ns = t_ns
                self._at(t_ns, modem, None)

    def _speak(self, modem: _Modem, t_ns: int) -> None:
        hears_until_ns = max((r.ends_ns for r in modem.hearing if r.begins_ns <= t_ns < r.ends_ns), default=t_ns)
        busy_until_ns = max(hears_until_ns, modem.speaks_until_ns)
        if busy_until_ns > t_ns:
            self._try(modem, busy_until_ns + modem.random.randrange(PAUSE_NS))
            return
        _, payload = modem.to_say.popleft()
        modem.counters.said += 1
        ends_ns = t_ns + self.water.airtime_ns(payload)
        modem.spoke_from_ns, modem.speaks_until_ns = t_ns, ends_ns
        for reception in modem.hearing:  # what comes in while it speaks
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
        for old in listener.hearing:
            if old.begins_ns < new.ends_ns and new.begins_ns < old.ends_ns:
                old.spoilt, new.spoilt = old.spoilt or "collision", "collision"
        if listener.spoke_from_ns < new.ends_ns and begins_ns < listener.speaks_until_ns:
            new.spoilt = new.spoilt or "speaking"
        listener.hearing.append(new)
        self._at(new.ends_ns, listener, new)

    # -- hearing --------------------------------------------------------------------------------------------------------

    def _heard(self, modem: _Modem, reception: Reception, t_ns: int) -> None:
        modem.hearing.remove(reception)
        missed = modem.random.random() < self.water.loss
        why = reception.spoilt or ("chance" if missed else "")
        if not why and self.spoils is not None and self.spoils(t_ns, modem.number, reception.payload):
            why = "fault"
        if why:
            modem.counters.lost[why] += 1
            return
        modem.counters.heard += 1
        if len(modem.heard) >= HEARD:
            modem.heard.popleft()
            modem.counters.dropped += 1
        modem.heard.append(reception.payload)

    # -- helpers --------------------------------------------------------------------------------------------------------

    def _at(self, t_ns: int, modem: _Modem, reception: Reception | None) -> None:
        self._number += 1
        heappush(self._events, (t_ns, self._number, modem, reception))

    def _way_m(self, one: _Modem, other: _Modem) -> float | None:
        """How far apart they are; None where it is too far to hear."""
        way_m = dist(one.at_m, other.at_m)
        return way_m if way_m <= self.water.range_m else None

    def _modem(self, name: str) -> _Modem:
        if name not in self._modems:
            raise UsageError(f"no modem {name!r} in the water", expected=", ".join(self._modems))
        return self._modems[name]
