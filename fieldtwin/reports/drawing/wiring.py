"""The content of a drawing: controller, buses, devices, and their emulators.

The input is a loaded system and, for a prototype, its file. This module opens nothing and draws nothing.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Any

from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.devices.config import BusConfig, DeviceConfig
from fieldtwin.twin.prototype.file import Prototype
from fieldtwin.twin.site.system import System


@dataclass(frozen=True, slots=True)
class Station:
    """A device on its bus: its address, its poll period, its writable outputs. `plays`: its recording, simulation or model in
    a prototype.
    """

    name: str
    device: str
    address: str
    asked: str
    writable: tuple[str, ...]
    far: str
    plays: str


@dataclass(frozen=True, slots=True)
class DrawnBus:
    """A bus with the plant's endpoint. `stand_in`: where its emulators listen; empty if the real bus is used."""

    name: str
    kind: str
    endpoint: str
    rate: str
    stand_in: str
    stations: tuple[Station, ...]


@dataclass(frozen=True, slots=True)
class Logic:
    """A program of the PLC: its source, and the number of variables that are bound to tags."""

    name: str
    source: str
    cycle: str
    inputs: int
    outputs: int


@dataclass(frozen=True, slots=True)
class Server:
    """A server of the gateway. It serves tags as registers, or forwards requests to the unit IDs of a bus."""

    name: str
    endpoint: str
    offers: str


@dataclass(frozen=True, slots=True)
class Wiring:
    """The buses, programs and servers of a system. `prototype`: the drawing includes the emulators of a prototype file."""

    system: str
    prototype: bool
    wires: tuple[DrawnBus, ...]
    programs: tuple[Logic, ...]
    servers: tuple[Server, ...]

    def as_data(self) -> dict[str, Any]:
        """Return the wiring as JSON data."""
        return asdict(self)


def wiring(system: System, prototype: Prototype | None = None) -> Wiring:
    """Return the wiring of `system`; with `prototype`, also the emulators of each bus."""
    return Wiring(
        system.name,
        prototype is not None,
        tuple(_wire(system, bus, prototype) for bus in system.buses.values()),
        tuple(_programs(system)),
        tuple(_servers(system, free_ports=prototype is not None)),
    )


def _wire(system: System, bus: BusConfig, prototype: Prototype | None) -> DrawnBus:
    listen = prototype.buses[bus.name].listen if prototype else None
    stations = tuple(_station(device, prototype) for device in system.devices_on(bus.name))
    kind, rate = _kind(bus)
    return DrawnBus(bus.name, kind, str(bus.endpoint), rate, str(listen or ""), stations)


def _kind(bus: BusConfig) -> tuple[str, str]:
    endpoint: Endpoint = bus.endpoint
    if endpoint.is_can:
        return "CAN bus", f"{bus.bitrate // 1000} kbit/s"
    return ("serial line" if endpoint.is_serial else "network"), ""


def _station(device: DeviceConfig, prototype: Prototype | None) -> Station:
    emulated = prototype.devices.get(device.name) if prototype else None
    word = "node" if device.profile.protocol == "canopen" else "unit"
    far = ""
    if device.profile.inbox is not None:
        far = "topside end"
        if emulated is not None and emulated.form.far_link is not None:
            link = emulated.form.far_link
            far += f": {link.bytes_per_s:g} byte/s, {link.latency_ms} ms, {link.loss * 100:g} % lost"
    return Station(
        device.name,
        device.profile.form.device,
        f"{word} {device.address}",
        _asked(device),
        tuple(tag for tag in device.profile.tags if tag in device.writable),
        far,
        emulated.plays if emulated else "",
    )


def _asked(device: DeviceConfig) -> str:
    if device.tpdo1 is not None:
        return f"TPDO1 every {_time(device.tpdo1.event_ms)}"
    periods = sorted(set(device.poll.values()))
    return "every " + ", ".join(map(_time, periods)) if periods else ""


def _time(ms: int) -> str:
    return f"{ms / 1000:g} s" if ms >= 1000 else f"{ms} ms"


def _programs(system: System) -> Iterator[Logic]:
    tasks = system.plc.tasks
    for name, program in system.plc.programs.items():
        task = tasks.get(program.task) if program.task else next(iter(tasks.values()), None)
        if task is None:
            cycle = f"every {_time(system.plc.cycle_ms)}"
        elif task.single is not None:
            cycle = f"at {task.single}"
        else:
            cycle = f"every {_time(task.interval_ms or 0)}"
        yield Logic(name, program.source, cycle, len(program.inputs), len(program.outputs))


def _servers(system: System, *, free_ports: bool) -> Iterator[Server]:
    serving = system.serving.for_run(allow_writes=False, free_ports=free_ports)
    for serve in serving.serve:
        count = len(serve.tags)
        yield Server(serve.name, str(serve.listen), f"{count} tag{'s' if count > 1 else ''} as registers")
    for opcua in serving.opcua:
        yield Server(opcua.name, opcua.url, "every tag as a variable")
    for http in serving.http:
        yield Server(http.name, http.url, "the REST and WebSocket interface")
    for mqtt in serving.mqtt:
        yield Server(mqtt.name, mqtt.url, mqtt.place)
    for bridge in serving.bridges:
        reached = ", ".join(bus for bus in system.buses if bus in bridge.buses)
        yield Server(bridge.name, str(bridge.listen), f"units of {reached}")
