"""A new configuration for a running bus, which takes over each device's part between two of its polls."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from fieldtwin.gateway.devices.canopen_device import CanopenDriver
from fieldtwin.gateway.devices.config import BusConfig, DeviceConfig
from fieldtwin.gateway.devices.register_device import RegisterDriver

AnyDriver = RegisterDriver | CanopenDriver


@dataclass
class PendingConfig:
    """The new configuration of a bus and its devices, by name. Buses, devices and addresses are the same as before.

    `taken` is called with each driver as soon as it has its new configuration; `done` is set when all drivers have theirs.
    """

    bus: BusConfig
    devices: Mapping[str, DeviceConfig]
    taken: Callable[[AnyDriver], None]
    done: asyncio.Event = field(default_factory=asyncio.Event)
