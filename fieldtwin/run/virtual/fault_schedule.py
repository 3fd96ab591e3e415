"""Faults that a seed chooses: kind, target, begin and end.

The last part of a run has no fault, so that recovery can be observed.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace
from random import Random
from typing import Any

from fieldtwin.emulators.faults.can_fault import only_sends
from fieldtwin.emulators.faults.fault import InjectionPoint
from fieldtwin.emulators.faults.registry import FAULTS, fault_class
from fieldtwin.emulators.faults.schema import parse_fault
from fieldtwin.emulators.faults.values.value_ranges import numbers
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.gateway.core.files.nearest import did_you_mean
from fieldtwin.twin.prototype.fault_aims import target
from fieldtwin.twin.prototype.group import GroupMember, SystemGroup
from fieldtwin.twin.site.system import System

MEAN_S = 120.0
"""Mean number of seconds between two faults."""
SHORTEST_S, LONGEST_S = 0.5, 20.0
CALM_S = 120.0
"""Time in seconds without faults at the end."""
MOST = 500
NOT_BY_CHANCE = frozenset({"set", "late-frame"})
"""Faults that are never random.

`set` is not a fault; no gateway could detect `late-frame`, because no CAN frame carries the time of its values.
"""
UNSEEN_ON_TCP = frozenset({"corrupt-bits", "collision", "wrong-baud", "wrong-parity", "noise", "echo"})
"""Serial faults that are not injected on sockets. Modbus TCP has no check sum, so a gateway cannot detect them there."""


@dataclass(frozen=True, slots=True)
class RandomFaults:
    """The choice of random faults.

    `mean_s`: mean seconds between two faults. `kinds`: names of faults; empty: all that a gateway can detect, without
    faults of values. `aims`: DEVICE, BUS (each device on it) or DEVICE.TAG (the fault affects that register or object
    only); in a group they are prefixed by the name of their system, and what the systems share has a name too. Empty:
    every device. `guided`: the begins of the faults depend on the states of the programs (see
    `fieldtwin.run.virtual.guided_faults`).
    """

    mean_s: float = MEAN_S
    kinds: tuple[str, ...] = ()
    aims: tuple[str, ...] = ()
    guided: bool = False

    def check(self, group: SystemGroup) -> None:
        """Raise `UsageError` for a fault or an aim that does not exist, and for kinds that fit no aim."""
        if self.mean_s <= 0:
            raise UsageError(
                "the time between two random faults", expected="more than 0, such as 30s", got=f"{self.mean_s:g}"
            )
        for name in self.kinds:
            if fault_class(name).name in NOT_BY_CHANCE:
                raise UsageError(f"{name!r} cannot be chosen at random", hint="put it into the scenario as a step")
        members = group.members.values()
        known = [m.prefix + aim for m in members for aim in _aims_of(m.system)] + list(group.shared)
        for aim in self.aims:
            if aim in known:
                continue
            hint = did_you_mean(aim, known)
            raise UsageError(
                f"no device, bus or tag {aim!r} to aim random faults at",
                expected="DEVICE, BUS or DEVICE.TAG",
                hint=hint,
            )
        choices = [choice for m in members for choice in _choices(m.system, self.under(m.prefix))]
        if not any(names for _, _, names in choices) and not set(group.shared) & set(self.aims):
            raise UsageError(
                "none of these faults fits the targets",
                got=f"{', '.join(self.kinds)} at {', '.join(self.aims) or 'every device'}",
            )

    def under(self, prefix: str) -> RandomFaults:
        """Return the part of this choice that concerns one system of a group, whose names begin with `prefix` (empty: a system
        alone).
        """
        aims = tuple(aim.removeprefix(prefix) for aim in self.aims if aim.startswith(prefix))
        return replace(self, aims=aims or (("",) if self.aims else ()))


ANY = RandomFaults()


def _aims_of(system: System) -> Iterator[str]:
    yield from system.buses
    for device in system.devices.values():
        yield device.name
        yield from (f"{device.name}.{tag}" for tag in device.profile.tags)


def _choices(system: System, wanted: RandomFaults) -> list[tuple[str, str, list[str]]]:
    """Return each (device, tag or empty, names of the faults that can take effect there), in the order of the system file."""
    found: list[tuple[str, str, list[str]]] = []
    for device in system.devices.values():
        of_tag = [aim.partition(".")[2] for aim in wanted.aims if aim.startswith(f"{device.name}.")]
        tags = ["", *of_tag] if {device.name, device.bus} & set(wanted.aims) or not wanted.aims else of_tag
        for tag in tags:
            found.append((device.name, tag, list(_fitting(system, wanted, device.name, tag))))
    return found


def _fitting(system: System, wanted: RandomFaults, device: str, tag: str) -> Iterator[str]:
    endpoint = system.buses[system.devices[device].bus].endpoint
    for name, kind in FAULTS.items():
        if name in NOT_BY_CHANCE or (wanted.kinds and name not in wanted.kinds):
            continue
        # with this fault the device reports a wrong value, so it is chosen only on request
        if kind.kind is InjectionPoint.VALUE:
            if wanted.kinds and (_struck(system, name, device) if not tag else tag in _struck(system, name, device)):
                yield name
        elif _is_seen(name, endpoint) and _can_aim(system, name, device, tag):
            yield name


def _is_seen(name: str, endpoint: Endpoint) -> bool:
    return endpoint.is_serial or name not in UNSEEN_ON_TCP


def _struck(system: System, name: str, device: str) -> list[str]:
    """Return the tags of `device` whose values the fault `name` can change."""
    return [
        tag.name
        for tag in numbers(system.devices[device].profile.tags.values())
        if _can_aim(system, name, device, tag.name)
    ]


def _can_aim(system: System, name: str, device: str, tag: str) -> bool:
    try:
        target(system, parse_fault({"name": name, "device": device, "register": tag}))
    except UsageError:
        return False
    return True


@dataclass(frozen=True, slots=True)
class FaultChoice:
    """A target of random faults. `kinds` are the names of the faults that can take effect there; `tag` is empty for a whole
    device.
    """

    member: GroupMember
    device: str
    tag: str
    kinds: tuple[str, ...]

    def only(self, kinds: Collection[str]) -> FaultChoice:
        """Return this target with these kinds of faults only."""
        return replace(self, kinds=tuple(kind for kind in self.kinds if kind in kinds))


def fault_choices(member: GroupMember, wanted: RandomFaults) -> list[FaultChoice]:
    """Return the targets of random faults in one system of a group, in the order of its file."""
    found = _choices(member.system, wanted.under(member.prefix))
    return [FaultChoice(member, device, tag, tuple(names)) for device, tag, names in found if names]


def random_schedule(
    group: SystemGroup, seed: int, duration_s: float, wanted: RandomFaults = ANY
) -> tuple[dict[str, Any], ...]:
    """Return faults in the form of a fault file; the same for the same systems, seed, duration and choice.

    Each system's faults are drawn with its own seed. The faults of the shared resources follow. The faults of systems are left
    out if they are guided, because they are then chosen during the run.
    """
    end_s, found = last_s(duration_s), list[dict[str, Any]]()
    if not wanted.guided:
        found += [fault for member in group.members.values() for fault in _of_member(member, seed, end_s, wanted)]
    if not wanted.aims or set(wanted.aims) & set(group.shared):
        random = Random(f"faults {seed} {' '.join(group.shared)}")
        found += group.random_shared_faults(random, wanted.kinds, wanted.mean_s, end_s)
    return tuple(sorted(found, key=lambda fault: float(fault["from"])))


def last_s(duration_s: float) -> float:
    """Return the time in seconds at which the last random fault of a run must have ended."""
    return duration_s - min(CALM_S, duration_s / 2)


def _of_member(member: GroupMember, seed: int, end_s: float, wanted: RandomFaults) -> Iterator[dict[str, Any]]:
    number = 0
    random = Random(f"faults {seed} {member.name}".strip())
    choices = fault_choices(member, wanted)
    at_s = random.expovariate(1 / wanted.mean_s)
    while at_s < end_s and number < MOST and choices:
        choice = random.choice(choices)
        fault = drawn_fault(choice, f"{member.name}-f{number + 1}".removeprefix("-"), at_s, end_s, random)
        if fault["until"] > fault["from"]:
            number += 1
            yield fault
        at_s += random.expovariate(1 / wanted.mean_s)


def drawn_fault(choice: FaultChoice, id: str, at_s: float, end_s: float, random: Random) -> dict[str, Any]:
    """Return a fault at this target that begins at `at_s` and ends at `end_s` or before, in seconds of the run."""
    until_s = min(end_s, at_s + random.uniform(SHORTEST_S, LONGEST_S))
    fault: dict[str, Any] = {
        "id": id,
        "name": random.choice(choice.kinds),
        "device": choice.member.prefix + choice.device,
        "from": round(at_s, 3),
        "until": round(until_s, 3),
    }
    of_values = FAULTS[fault["name"]].kind is InjectionPoint.VALUE
    if choice.tag or of_values:
        fault["register"] = choice.tag or random.choice(_struck(choice.member.system, fault["name"], choice.device))
    if random.random() < 0.5 and not of_values and not only_sends(FAULTS[fault["name"]]):
        fault["probability"] = round(random.uniform(0.1, 1.0), 2)
    return fault
