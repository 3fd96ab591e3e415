"""A configuration that a bus shall take over while it runs, each device between two of its polls."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from fieldtwin.gateway.devices.canopen_device import CanopenDriver
from fieldtwin.gateway.devices.config import BusConfig, DeviceConfig
from fieldtwin.gateway.devices.register_device import RegisterDriver

AnyDriver = RegisterDriver | CanopenDriver


@dataclass
class Coming:
    """`bus` and `devices`, all of that bus, by name: the same buses and devices as before, at the same places.

    `taken` is called with each driver at once when it has its new configuration; `done` is set when all have.
    """

    bus: BusConfig
    devices: Mapping[str, DeviceConfig]
    taken: Callable[[AnyDriver], None]
    done: asyncio.Event = field(default_factory=asyncio.Event)
