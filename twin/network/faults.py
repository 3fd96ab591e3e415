"""Where a fault of a network goes: into the water, or into one of its systems, under the names that it has there. Pure."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from fieldtwin.emulators.faults.schema import FaultSpec
from fieldtwin.twin.network.network import WATER, Network
from fieldtwin.twin.network.water_faults import check_water_fault
from fieldtwin.twin.prototype.fault_aims import target


def check_network_fault(network: Network, spec: FaultSpec) -> None:
    """Raises `WrongAim` for what is not there, in the systems or between them."""
    if spec.aim.bus == WATER:
        check_water_fault(network, spec)
    else:
        target(network.whole, spec)


def placed(network: Network, fault: Mapping[str, Any]) -> tuple[str, dict[str, Any]]:
    """The system that a fault is in, or `WATER`, and the fault as it is told there. Raises `UsageError` for no such system."""
    if fault.get("bus") == WATER:
        return WATER, dict(fault)
    member, _ = network.split(str(fault.get("device") or fault.get("bus") or ""))
    local = {key: network.split(said)[1] if key in ("device", "bus") else said for key, said in fault.items()}
    return member, local


def placed_all(network: Network, faults: Iterable[Mapping[str, Any]]) -> dict[str, tuple[dict[str, Any], ...]]:
    """All of them, by where they are in; a system without one is not among them."""
    found: dict[str, tuple[dict[str, Any], ...]] = {}
    for fault in faults:
        where, local = placed(network, fault)
        found[where] = (*found.get(where, ()), local)
    return found
