"""Assigns the faults of a network: to the acoustic channel, or to one of its systems under that system's own names. Pure."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from fieldtwin.emulators.faults.schema import FaultSpec
from fieldtwin.twin.network.network import WATER, Network
from fieldtwin.twin.network.water_faults import check_water_fault
from fieldtwin.twin.prototype.fault_aims import target


def check_network_fault(network: Network, spec: FaultSpec) -> None:
    """Check a fault's aim. Raises `WrongAim` if it is neither in the systems nor in the acoustic channel."""
    if spec.aim.bus == WATER:
        check_water_fault(network, spec)
    else:
        target(network.whole, spec)


def placed(network: Network, fault: Mapping[str, Any]) -> tuple[str, dict[str, Any]]:
    """Return the system of a fault, or `WATER`, and the fault with that system's own names.

    Raises `UsageError` for an unknown system.
    """
    if fault.get("bus") == WATER:
        return WATER, dict(fault)
    member, _ = network.split(str(fault.get("device") or fault.get("bus") or ""))
    local = {key: network.split(said)[1] if key in ("device", "bus") else said for key, said in fault.items()}
    return member, local


def placed_all(network: Network, faults: Iterable[Mapping[str, Any]]) -> dict[str, tuple[dict[str, Any], ...]]:
    """Return all faults by their place. A system without a fault is not included."""
    found: dict[str, tuple[dict[str, Any], ...]] = {}
    for fault in faults:
        where, local = placed(network, fault)
        found[where] = (*found.get(where, ()), local)
    return found
