"""The observatory's prototype in this process: the drivers, emulators and wires of a run, without its processes."""

from __future__ import annotations

import shutil
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path

from fieldtwin.emulators.emulator import EmulatedUnit
from fieldtwin.gateway.connections.os_connector import OsConnector
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.devices.canopen_device import CanopenDriver
from fieldtwin.gateway.devices.register_device import RegisterDriver
from fieldtwin.gateway.protocols.modbus.client import ModbusClient
from fieldtwin.gateway.runtime.tags import TagTable
from fieldtwin.gateway.wallclock import WallClock
from fieldtwin.twin.plant.mapping import MappedConnector, mapped_endpoint
from fieldtwin.twin.plant.physical import make_drivers
from fieldtwin.twin.prototype.field import FieldSimulator
from fieldtwin.twin.prototype.file import Prototype, load_prototype
from fieldtwin.twin.prototype.prototype import DigitalTwinPrototype
from fieldtwin.twin.site.system import System, load_system

CHECKOUT = Path(__file__).resolve().parents[3]
SYSTEMS = CHECKOUT / "profiles" / "systems"
CLOCK = WallClock()


def observatory() -> tuple[System, Prototype]:
    """The shipped reference system and its prototype file."""
    system = load_system(str(SYSTEMS / "observatory.yaml"))
    return system, load_prototype(system)


@dataclass
class Rig:
    """Listening emulators, and the drivers of the same system, attached to them."""

    twin: DigitalTwinPrototype
    field: FieldSimulator
    tags: TagTable
    drivers: dict[str, RegisterDriver | CanopenDriver]

    def register_driver(self, name: str) -> RegisterDriver:
        driver = self.drivers[name]
        assert isinstance(driver, RegisterDriver)
        return driver

    def unit(self, name: str) -> EmulatedUnit:
        unit = self.field.devices[name].unit
        assert unit is not None
        return unit


@asynccontextmanager
async def rig(
    run_dir: Path, prototype: Prototype | None = None, carried: dict[str, Endpoint] | None = None
) -> AsyncIterator[Rig]:
    """`carried` gives the endpoint of a bus that is opened in a different place than its emulator's (through a link)."""
    system, shipped = observatory()
    twin = DigitalTwinPrototype(system, prototype or shipped, CLOCK)
    field = twin.field(run_dir)
    await field.open()
    tags = TagTable(CLOCK)
    drivers = make_drivers(system, tags, CLOCK)
    opened: list[ModbusClient] = []
    try:
        where = {**field.listening, **(carried or {})}
        mapping = {
            bus.endpoint: mapped_endpoint(bus.endpoint, where[name])
            for name, bus in system.buses.items()
            if not (bus.endpoint.is_serial and where[name].scheme != "pty")
        }
        connector = MappedConnector(OsConnector(), mapping)
        for driver in drivers.values():
            bus = system.buses[driver.config.bus]
            if isinstance(driver, RegisterDriver) and bus.endpoint in mapping:
                connection = await connector.open_bytes(bus.endpoint)
                client = ModbusClient.at(bus.endpoint, connection, CLOCK, timeout_s=2.0)
                opened.append(client)
                driver.attach_client(connection, client)
        yield Rig(twin, field, tags, drivers)
    finally:
        for client in opened:
            await client.aclose()
        await field.aclose()


def copy_systems(folder: Path) -> Path:
    """Copy the shipped profiles and recordings to `folder`, for a test to change; return the folder of the systems."""
    shutil.copytree(CHECKOUT / "profiles", folder / "profiles")
    shutil.copytree(CHECKOUT / "recordings", folder / "recordings")
    return folder / "profiles" / "systems"
