"""A new configuration that a running bus is to take over, each device between two of its polls."""

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
    """`bus` and `devices`, all on that bus, by name: the same buses and devices as before, at the same addresses.

    `taken` is called with each driver as soon as it has its new configuration; `done` is set when all have.
    """

    bus: BusConfig
    devices: Mapping[str, DeviceConfig]
    taken: Callable[[AnyDriver], None]
    done: asyncio.Event = field(default_factory=asyncio.Event)
