"""The project, the prototypes and the readable plants with which the tools of an agent work."""

from __future__ import annotations

import asyncio
from collections.abc import Collection
from pathlib import Path

from fieldtwin.agents.device_jobs import DeviceJobs
from fieldtwin.agents.plant_writes import PlantWrites
from fieldtwin.agents.project import Project
from fieldtwin.agents.results import Results
from fieldtwin.gateway.core.clock import Clock
from fieldtwin.gateway.core.concurrency.async_resource import AsyncResource
from fieldtwin.gateway.core.concurrency.nursery import Nursery
from fieldtwin.gateway.core.errors import NotAllowed
from fieldtwin.studio.live.attachment import Attachment
from fieldtwin.studio.live.gallery import Gallery
from fieldtwin.studio.live.instances import FoundInstance
from fieldtwin.studio.live.launching import Launcher, instance_name
from fieldtwin.studio.scenarios.runner import ScenarioRunner
from fieldtwin.twin.prototype.file import load_prototype
from fieldtwin.twin.site.system import load_system
from fieldtwin.twin.template.reach import reach

OWN = "agent-"
"""The beginning of the names of prototypes that an agent has started, so that they never take the name of a plant's run."""


class Workplace(AsyncResource):
    """The project, the prototypes of the agent, the running systems `plants` that it may read, the `writes` that it proposes,
    and the `devices` that it may read without a running system.

    Leaving the block ``async with`` stops all prototypes and the scenario that is running.
    """

    def __init__(
        self, folder: Path, plants: Collection[str], writes: PlantWrites, devices: DeviceJobs, clock: Clock
    ) -> None:
        super().__init__()
        self.writes = writes
        self.devices = devices
        self.project = Project(folder)
        self.plants = frozenset(plants)
        self.runner = ScenarioRunner()
        self.results = Results()
        self._gallery = Gallery(clock)
        self._launcher = Launcher()
        self._starting = asyncio.Lock()

    async def _start(self) -> None:
        await self._stack.enter_async_context(self._launcher)
        await self._stack.enter_async_context(self._gallery)
        await self._stack.enter_async_context(self.runner)
        await self._stack.enter_async_context(self.devices)
        nursery = await self._stack.enter_async_context(Nursery())
        nursery.start(self.writes.expire(), "expiry of proposals")

    async def instances(self) -> list[FoundInstance]:
        """Return the prototypes of the agent, and the running systems that it may read."""
        return [found for found in await self._gallery.found() if self._may_read(found.name)]

    def owns(self, instance: str) -> bool:
        """Return whether the agent has started this prototype, and it runs."""
        return self._launcher.owns(instance)

    async def start_prototype(self, system: str) -> str:
        """Start the prototype of a system, and return the name of its instance.

        Raises `NotAllowed` if its file uses a real bus or listens where other computers can connect.
        """
        path = self.project.system(system)
        reached = await asyncio.to_thread(_reached, path)
        if reached:
            raise NotAllowed(
                "an agent may not start this prototype: " + "; ".join(reached),
                hint=f"a user can start it: fieldtwin run {system} --prototype",
            )
        async with self._starting:
            return await self._launcher.start(path, OWN + instance_name(Path(path))[:30])

    async def stop_prototype(self, instance: str) -> None:
        """Stop a prototype of the agent."""
        self._check_own(instance)
        await self._launcher.stop(instance)

    async def read(self, instance: str) -> Attachment:
        """Return the observation of an instance that the agent may read. Raises `NotAllowed` or `UsageError`."""
        if not self._may_read(instance):
            allowed = ", ".join(sorted(self.plants)) or "none"
            raise NotAllowed(
                f"this agent may not read the instance {instance[:60]!r}",
                expected=f"a prototype that it has started, or a system that the user has enabled ({allowed})",
                hint=f"the user enables it with: fieldtwin mcp --plant {instance[:60]}",
            )
        attachment = await self._gallery.attached(instance)
        await attachment.wait_for_history()
        return attachment

    async def operate(self, instance: str) -> Attachment:
        """Return the observation of a prototype that the agent has started. Raises `NotAllowed` for every other instance."""
        self._check_own(instance)
        return await self.read(instance)

    def _may_read(self, instance: str) -> bool:
        return instance in self.plants or self.owns(instance)

    def _check_own(self, instance: str) -> None:
        if not self.owns(instance):
            raise NotAllowed(
                f"the agent has not started the prototype {instance[:60]!r}, so it cannot operate it",
                expected="the result of start_prototype",
                hint="a plant is read-only for agents; propose_write asks the user for a write",
            )


def _reached(path: str) -> tuple[str, ...]:
    system = load_system(path)
    return reach(system, load_prototype(system))
