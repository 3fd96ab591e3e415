"""The faults of a network's acoustic channel: packets that are sent and do not arrive.

Their targets are the modems of the network file. They have the same form as the faults of a bus.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from random import Random
from typing import Any

from fieldtwin.acoustic.schema import WATER
from fieldtwin.emulators.faults.engine import WireFaults
from fieldtwin.emulators.faults.fault import Active
from fieldtwin.emulators.faults.frames import FaultFrame, FrameDirection, Framing
from fieldtwin.emulators.faults.loss.drop import Drop
from fieldtwin.emulators.faults.schema import FaultSpec, parse_fault
from fieldtwin.emulators.faults.wrong_aim import WrongAim
from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.twin.prototype.fault_aims import known
from fieldtwin.twin.prototype.fault_history import FaultHistory
from fieldtwin.twin.prototype.field_status import ActiveFaultStatus

MOST = 1_000
MOST_AT_RANDOM = 500
RARER = 2.5
"""The mean time between two random losses is this many times that between two faults of a system."""
SHORTEST_S, LONGEST_S = 0.5, 60.0
"""The shortest and the longest random loss, in seconds."""
_AIMS = frozenset({"bus", "device", "nth", "every", "from_", "until", "probability", "optional"})


class AcousticFaults:
    """The active faults of the acoustic channel. Times `from` and `until` of a fault count from `start_ns`, the run's start."""

    def __init__(self, places: Collection[str], seed: int) -> None:
        """Create the faults of a channel. `places` are the names of the modems in it."""
        self.start_ns = 0
        self._places = places
        self._seed = seed
        self._wire = WireFaults(Framing.RAW)
        self.history = FaultHistory()
        self._numbers = {name: number for number, name in enumerate(places, 1)}

    def spoils(self, t_ns: int, listener: int, payload: bytes) -> bool:
        """Return whether a fault removes this packet for `listener` (`fieldtwin.emulators.wires.acoustic.Spoils`)."""
        return self._wire.decide(FaultFrame(FrameDirection.REPLY, Framing.RAW, payload, listener), t_ns) is not None

    def inject(self, said: Mapping[str, Any]) -> str:
        """Inject a fault and return its id. Raises `UsageError`."""
        spec = parse_fault(dict(said), number=len(self._wire.active) + 1)
        check_water_fault(self._places, spec)
        if spec.id in self._wire.active:
            raise UsageError(
                f"the fault {spec.id!r} is already active", hint="clear it first, or choose a different id"
            )
        if len(self._wire.active) >= MOST:
            raise UsageError("too many faults at once", expected=f"at most {MOST}")
        until_ns = None if spec.until_s is None else self.start_ns + round(spec.until_s * NS_PER_S)
        units = (self._numbers[spec.aim.device],) if spec.aim.device else ()
        active = Active(
            spec.id,
            spec.make(),
            spec.aim,
            Random(f"{self._seed} {spec.id}"),
            self.start_ns + round(spec.from_s * NS_PER_S),
            until_ns,
            units=units,
        )
        self._wire.put_in(active)
        self.history.add(active, f"{WATER} {spec.aim.device}".strip())
        return spec.id

    def clear(self, id: str) -> None:
        """Clear a fault. Does nothing if it is not active or its time is over."""
        self._wire.take_away(id)

    def active(self) -> list[ActiveFaultStatus]:
        """Return the active faults, and how often each took effect."""
        return [
            ActiveFaultStatus(id=id, name=active.fault.name, bus=WATER, device=active.aim.device, struck=active.struck)
            for id, active in self._wire.active.items()
        ]


def check_water_fault(places: Collection[str], spec: FaultSpec) -> None:
    """Raise `WrongAim` if the fault does not apply to the acoustic channel, or if its modem is not in the channel."""
    if spec.kind is not Drop:
        raise WrongAim("name", f"fault {spec.kind.name!r} does not exist on the acoustic channel", expected=Drop.name)
    for key in sorted(spec.aim.model_fields_set - _AIMS):
        raise WrongAim(
            key, f"{key!r} has no meaning on the acoustic channel", expected="device: the modem that receives nothing"
        )
    if spec.aim.device:
        known("modem on the acoustic channel", spec.aim.device, places, "device")


def random_losses(places: Collection[str], random: Random, mean_s: float, last_s: float) -> list[dict[str, Any]]:
    """Return random losses of packets, at all modems or at one, in the form of a fault file.

    `mean_s`: mean seconds between two faults of a system; `last_s`: the time in seconds, from the run's start, at which all
    losses are over.
    """
    found: list[dict[str, Any]] = []
    mean_s *= RARER
    at_s, number = random.expovariate(1 / mean_s), 0
    while at_s < last_s and number < MOST_AT_RANDOM:
        number += 1
        until_s = min(last_s, at_s + random.uniform(SHORTEST_S, LONGEST_S))
        lost: dict[str, Any] = {"id": f"{WATER}-f{number}", "name": Drop.name, "bus": WATER}
        if random.random() < 0.5:
            lost["device"] = random.choice(list(places))
        lost |= {"from": round(at_s, 3), "until": round(until_s, 3), "probability": round(random.uniform(0.1, 1.0), 2)}
        if lost["until"] > lost["from"]:
            found.append(lost)
        at_s += random.expovariate(1 / mean_s)
    return found
