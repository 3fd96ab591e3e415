"""Gateway and PLC of a bench's system, as processes connected to its field simulator, which a test observes and controls.

These are the same processes as in every run, on the wall clock; retained values of earlier runs are not used. The module does
not depend on tests, and changes nothing in the field simulator.
"""

from __future__ import annotations

from contextlib import AsyncExitStack
from pathlib import Path
from typing import Any

import msgspec

from fieldtwin.gateway.core.clock import Clock
from fieldtwin.gateway.core.concurrency.nursery import Nursery
from fieldtwin.gateway.core.control import ControlClient, RemoteError
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.run.processes.children import Child
from fieldtwin.run.processes.plc_client import step_and_wait
from fieldtwin.run.processes.topside import TopsideController
from fieldtwin.twin.plant.controller import ControllerConfig
from fieldtwin.twin.plant.mapping import mapped_endpoint, mapping_to_json
from fieldtwin.twin.plant.physical import PhysicalTwin
from fieldtwin.twin.prototype.field import FieldSimulator
from fieldtwin.twin.site.resolved import write_resolved
from fieldtwin.twin.site.system import System

BY = "test"
PLC_COMMANDS = ("force", "unforce", "pause", "go", "step", "restart", "why")
"""Commands of the PLC's process that a test may use, each with the names of its arguments."""


class PlcProcesses:
    """The two processes: ``await open()``, then call the methods.

    `aclose` ends both processes, the gateway first, which makes the outputs safe.
    """

    def __init__(self, system: System, field: FieldSimulator, clock: Clock, folder: Path) -> None:
        self._system = system
        self._field = field
        self._clock = clock
        self._folder = folder
        self._stack = AsyncExitStack()
        self._children: list[Child] = []
        self._plc: ControlClient | None = None
        self._topside: TopsideController | None = None

    async def open(self, profiles: tuple[str, ...] = ()) -> None:
        """Start both processes. Raises `ChildFailed` with the output of a process that does not start."""
        try:
            await self._open(profiles)
        except BaseException:
            await self._stack.aclose()
            raise

    async def _open(self, profiles: tuple[str, ...]) -> None:
        system, folder = self._system, self._folder
        config = folder / "plc.json"
        config.write_bytes(PhysicalTwin(system).ecs.prepare(folder, cold=True).to_json())
        self._plc = await self._start("plc", "fieldtwin.plc", config)
        mapping = {}
        for bus, listening in self._field.listening.items():
            plant = system.buses[bus].endpoint
            mapping[plant] = mapped_endpoint(plant, listening)
        told = ControllerConfig(
            system=str(system.path.resolve()),
            run_dir=str(folder),
            allow_writes=True,
            mapping=mapping_to_json(mapping),  # the gateway opens only these endpoints, and none that is not emulated
            profiles=profiles,
            resolved=write_resolved(folder / "system.pickle", system),
        )
        config = folder / "gateway.json"
        config.write_bytes(msgspec.json.encode(told))
        await self._start("gateway", "fieldtwin.twin.plant.controller", config)
        device = next(iter(self._field.far), None)
        if device is not None:
            self._topside = TopsideController(system, device, self._field.far[device], self._clock)
            nursery = await self._stack.enter_async_context(Nursery())
            nursery.start(self._topside.run([]), "topside")

    async def _start(self, name: str, module: str, config: Path) -> ControlClient:
        child = Child(name, module, config, self._folder)
        self._children.append(child)
        self._stack.push_async_callback(child.end)
        client = await child.connect()
        self._stack.push_async_callback(client.aclose)
        return client

    async def aclose(self) -> None:
        await self._stack.aclose()

    def alive(self) -> None:
        """Raise `ChildFailed` if a process of the PLC ended by itself."""
        for child in self._children:
            failed = child.failure()
            if failed is not None:
                raise failed

    async def names(self) -> list[str]:
        """Return every tag and variable of the process image."""
        found: list[str] = (await self._call("image"))["names"]
        return found

    async def tag(self, name: str) -> dict[str, Any]:
        """Return ``value`` (a state by its name), ``quality``, ``reason``, ``age_s``, ``unit``, ``forced`` of a tag."""
        row = (await self._call("image", tags=[name]))["tags"][-1]
        words = dict(row["words"])
        value = row["value"]
        return {**row, "value": words.get(str(value), words.get(value, value)), "words": list(words.values())}

    async def steer(self, command: str, args: dict[str, Any]) -> dict[str, Any]:
        """Execute one of the commands in `PLC_COMMANDS`."""
        if command not in PLC_COMMANDS:
            raise UsageError(f"not a command for a PLC: {command!r}", expected=", ".join(PLC_COMMANDS))
        if command == "step":
            return {"scans": await step_and_wait(self._call, int(args["count"]), BY)}
        return await self._call(command, **args, by=BY)

    def send(self, period_s: int) -> None:
        """Send a command with this sample period (s) at the remote end of the transmitter."""
        if self._topside is None:
            raise UsageError("this system cannot be commanded", expected="a transmitter with a topside end")
        self._topside.send(period_s)

    async def _call(self, command: str, **args: Any) -> dict[str, Any]:
        self.alive()
        assert self._plc is not None
        try:
            answer: dict[str, Any] = await self._plc.call(command, **args)
        except RemoteError as e:
            if e.remote_exit_code == UsageError.exit_code:
                raise UsageError(str(e)) from e
            raise
        return answer
