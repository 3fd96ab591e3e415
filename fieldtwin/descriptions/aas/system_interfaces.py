"""The Modbus TCP devices of a system, as interfaces of an Asset Interfaces Description."""

from __future__ import annotations

import re

from fieldtwin.descriptions.aas.interface import Interface, interface_of
from fieldtwin.descriptions.conversion import Loss
from fieldtwin.descriptions.maps.modbus_forms import unit_uri
from fieldtwin.twin.site.system import System


def interfaces_of(system: System) -> tuple[list[Interface], list[Loss]]:
    """Return an interface for each device that the plant reaches over Modbus TCP, and what is lost.

    W3C's binding, which the description uses, has no other transport.
    """
    found: list[Interface] = []
    losses: list[Loss] = []
    for name, device in system.devices.items():
        endpoint = system.buses[device.bus].endpoint
        if endpoint.scheme != "tcp":
            losses.append(Loss(f"device {name}", "the interface", "the description has Modbus TCP only"))
            continue
        own: list[Loss] = []
        id_short = re.sub("[^A-Za-z0-9]", "_", f"Interface_{name}")
        found.append(interface_of(device.profile, unit_uri(endpoint, device.address), id_short, own))
        losses += [Loss(f"device {name}, {loss.place}", loss.what, loss.why, loss.note) for loss in own]
    return found, losses
