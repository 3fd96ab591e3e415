"""Faults that a seed chooses: what, on whom, from when to when. The last part of a run has none, so that recovery can be seen."""

from __future__ import annotations

from random import Random
from typing import Any

from emulators.faults.fault import Kind
from emulators.faults.registry import FAULTS
from twin.network import WATER, Network
from twin.system import System

MEAN_S = 120.0
"""One fault in so many seconds, on average."""
SHORTEST_S, LONGEST_S = 0.5, 20.0
CALM_S = 120.0
"""Without faults at the end."""
MOST = 500
WATER_MEAN_S = 300.0
LONGEST_IN_WATER_S = 60.0
NOT_BY_CHANCE = frozenset({"set", "late-frame"})
"""Nothing that goes wrong, and what no gateway could notice: no CAN frame says when its values were measured."""
UNSEEN_ON_TCP = frozenset({"corrupt-bits", "collision", "wrong-baud", "wrong-parity", "noise", "echo"})
"""Modbus TCP has no check sum of its own, and trusts TCP's: what no gateway could notice is no fault of a socket."""


def random_network_schedule(network: Network, seed: int, duration_s: float) -> tuple[dict[str, Any], ...]:
    """Those of each system as if it were alone with a seed of its own, under its name, and packets that the water loses."""
    found = []
    for member in network.members.values():
        for fault in random_schedule(member.system, f"{seed} {member.name}", duration_s):
            found.append({**fault, "id": f"{member.name}-{fault['id']}", "device": f"{member.name}.{fault['device']}"})
    random = Random(f"faults {seed} {WATER}")
    at_s, last_s, number = random.expovariate(1 / WATER_MEAN_S), _last_s(duration_s), 0
    while at_s < last_s and number < MOST:
        number += 1
        until_s = min(last_s, at_s + random.uniform(SHORTEST_S, LONGEST_IN_WATER_S))
        lost: dict[str, Any] = {"id": f"{WATER}-f{number}", "name": "drop", "bus": WATER}
        if random.random() < 0.5:
            lost["device"] = random.choice(list(network.places))
        lost |= {"from": round(at_s, 3), "until": round(until_s, 3), "probability": round(random.uniform(0.1, 1.0), 2)}
        if lost["until"] > lost["from"]:
            found.append(lost)
        at_s += random.expovariate(1 / WATER_MEAN_S)
    return tuple(sorted(found, key=lambda fault: float(fault["from"])))


def _last_s(duration_s: float) -> float:
    return duration_s - min(CALM_S, duration_s / 2)


def random_schedule(system: System, seed: int | str, duration_s: float) -> tuple[dict[str, Any], ...]:
    """Faults as a fault file has them; the same for the same system, seed and duration."""
    random = Random(f"faults {seed}")
    devices = list(system.devices.values())
    last_s = _last_s(duration_s)
    found: list[dict[str, Any]] = []
    at_s = random.expovariate(1 / MEAN_S)
    while at_s < last_s and len(found) < MOST and devices:
        device = random.choice(devices)
        endpoint = system.buses[device.bus].endpoint
        on = Kind.CAN if endpoint.is_can else Kind.BYTES
        names = [
            name
            for name, kind in FAULTS.items()
            if kind.kind is on and name not in NOT_BY_CHANCE and not (name in UNSEEN_ON_TCP and not endpoint.is_serial)
        ]
        until_s = min(last_s, at_s + random.uniform(SHORTEST_S, LONGEST_S))
        fault: dict[str, Any] = {
            "id": f"f{len(found) + 1}",
            "name": random.choice(names),
            "device": device.name,
            "from": round(at_s, 3),
            "until": round(until_s, 3),
        }
        if random.random() < 0.5:
            fault["probability"] = round(random.uniform(0.1, 1.0), 2)
        if fault["until"] > fault["from"]:
            found.append(fault)
        at_s += random.expovariate(1 / MEAN_S)
    return tuple(found)
