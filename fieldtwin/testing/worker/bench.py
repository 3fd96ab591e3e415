"""The setup of one test: a field simulator with its own endpoints and their traffic, optionally with gateway and PLC.

A `WorkerBench` lives from `open` to `aclose`; its folder contains its files and virtual serial ports, and `aclose` removes it.
"""

from __future__ import annotations

import asyncio
import math
import shutil
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from fieldtwin.gateway.core.clock import Clock
from fieldtwin.gateway.core.concurrency.nursery import Nursery
from fieldtwin.gateway.core.connection import CanConnection
from fieldtwin.gateway.core.errors import ConnectionLost, UsageError
from fieldtwin.gateway.core.files.profile import Tag
from fieldtwin.gateway.devices.codec import decode, decode_little
from fieldtwin.testing.worker.one_device import endpoint_words
from fieldtwin.testing.worker.running_plc import PlcProcesses
from fieldtwin.testing.worker.wire_log import WireLog
from fieldtwin.twin.plant.mapping import mapped_endpoint
from fieldtwin.twin.prototype.field import FieldSimulator
from fieldtwin.twin.prototype.file import Prototype
from fieldtwin.twin.site.system import System


class WorkerBench:
    """The field simulator of a system. `open` raises the errors of the field simulator and of its emulators."""

    def __init__(self, system: System, prototype: Prototype, clock: Clock, folder: Path) -> None:
        self.system = system
        self.field = FieldSimulator(system, prototype, folder, clock)
        self.log = WireLog(system, clock)
        self.plc: PlcProcesses | None = None
        self._clock = clock
        self._folder = folder
        self._nursery = Nursery()
        self._listeners: list[CanConnection] = []

    async def open(self) -> None:
        await self.field.open()
        self.field.faults.watch(self.log.on_bytes)
        self._nursery.start(self.field.run(), "field simulator")
        for bus, listening in self.field.listening.items():
            if listening.is_can:
                listener = await self.field.join(bus, "test")
                self._listeners.append(listener)
                self._nursery.start(self._listen(bus, listener), f"listener on {bus}")

    async def _listen(self, bus: str, listener: CanConnection) -> None:
        try:
            while True:
                self.log.on_frame(bus, await listener.recv())
        except ConnectionLost:
            await asyncio.Event().wait()  # the bus is closed, but the test may continue

    async def control(self, profiles: tuple[str, ...] = ()) -> None:
        """Start the system's gateway and PLC with this field simulator. Further calls have no effect."""
        if self.plc is None:
            plc = PlcProcesses(self.system, self.field, self._clock, self._folder)
            await plc.open(profiles)
            self.plc = plc

    async def aclose(self) -> None:
        if self.plc is not None:
            await self.plc.aclose()
        await self._nursery.__aexit__(None, None, None)
        for listener in self._listeners:
            await listener.aclose()
        await self.field.aclose()
        shutil.rmtree(self._folder, ignore_errors=True)

    def describe(self) -> dict[str, Any]:
        """Return the description of the bench.

        It has ``buses`` and ``far`` (endpoints of the buses, and of the remote ends of transmitters' links, as plain data), and
        ``devices`` (bus, unit, profile, tags, model or recording).
        """
        buses = {}
        for name, listening in self.field.listening.items():
            plant = self.system.buses[name].endpoint
            buses[name] = endpoint_words(mapped_endpoint(plant, listening))
        return {
            "system": self.system.name,
            "file": str(self.system.path),
            "buses": buses,
            "far": {name: endpoint_words(endpoint) for name, endpoint in self.field.far.items()},
            "devices": {
                name: {
                    "bus": config.bus,
                    "unit": config.address,
                    "profile": config.profile.name,
                    "tags": list(config.profile.tags),
                    "plays": self.field.devices[name].plays,
                }
                for name, config in self.system.devices.items()
                if name in self.field.devices
            },
        }

    def alive(self) -> None:
        """Raise the error of an emulator that has failed, if any."""
        failure = self._nursery.failure()
        if failure is not None:
            raise failure
        if self.plc is not None:
            self.plc.alive()

    def set(self, device: str, tag: str, value: Any) -> None:
        """Set `tag` in `device` to `value`; None restores the recorded or simulated value."""
        self._tag(device, tag)
        self.field.faults.set_value(device, tag, value)

    def held(self, device: str, tag: str) -> Any:
        """Return the value of `tag` in `device`, in engineering units; None before its first value."""
        found = self._tag(device, tag)
        config = self.system.devices[device]
        put = self.field.faults.value_set(device, tag)
        if put is not None:  # a sampling sensor uses the value only at its next sample
            return _as_held(found, put)
        emulated = self.field.devices[device]
        raw = next((h.raw for h in reversed(list(emulated.journal.since(0))) if h.tag == tag), None)
        if raw is None:
            return None
        little = self.system.buses[config.bus].endpoint.is_can
        value = (decode_little if little else decode)(found, raw, 0).value
        return value.hex() if isinstance(value, bytes) else value

    def _tag(self, device: str, tag: str) -> Tag:
        if device not in self.field.devices:
            raise UsageError(f"no emulated device {device!r}", expected=", ".join(self.field.devices))
        tags = self.system.devices[device].profile.tags
        if tag not in tags:
            raise UsageError(f"{device} has no tag {tag!r}", expected=", ".join(tags))
        return tags[tag]

    def fault(self, said: Mapping[str, Any]) -> str:
        """Inject a fault and return its ID. Times in its description count from now."""
        self.field.faults.start_ns = self.field._clock.monotonic_ns()
        return self.field.faults.inject(said)


def _as_held(tag: Tag, value: float) -> float | int | bool:
    """Return the value that the device can hold for `value`, in engineering units: an integer type rounds to its nearest step."""
    if tag.type == "bool":
        return bool(value)
    if tag.type.startswith("float") or math.isnan(value) or tag.scale_by is not None:
        return value
    number = round((value - tag.offset) / tag.scale)
    return number if (tag.scale, tag.offset) == (1, 0) else number * tag.scale + tag.offset


def new_folder() -> Path:
    """Return a new folder for a bench, with a path short enough for sockets and links."""
    return Path(tempfile.mkdtemp(prefix="ft-test-"))
