"""One Modbus interface of a device, as an Asset Interfaces Description (IDTA 02017) holds it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from fieldtwin.descriptions.conversion import Loss
from fieldtwin.descriptions.maps.modbus_forms import READ_FUNCTIONS, abilities, properties
from fieldtwin.gateway.core.files.profile import DeviceProfile

ABILITIES = abilities("an AID", access=False)


@dataclass(frozen=True)
class Interface:
    """A Modbus interface: its idShort, its title, the URI of its unit, and its properties in the terms of W3C's binding."""

    id_short: str
    title: str
    base: str
    properties: Mapping[str, Mapping[str, Any]]


def interface_of(profile: DeviceProfile, base: str, id_short: str, losses: list[Loss]) -> Interface:
    """Return the interface of a profile at the URI `base`, and add what it loses to `losses`.

    An AID has no operations. Each form states the function that reads its table, so that no program writes the value.
    """
    found = {}
    for name, tag, described in properties(profile, ABILITIES, base, losses):
        form = described["forms"][0]
        form["href"] = form["href"].removeprefix(base)
        form["modv:function"] = READ_FUNCTIONS[tag.registers.table]
        found[name] = described
    return Interface(id_short, profile.name, base, found)
