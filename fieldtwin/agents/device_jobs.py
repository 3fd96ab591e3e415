"""Commands that only read devices, for an agent: each is a child process that the agent can ask for later and cancel.

The user names the systems whose buses may be opened. The endpoint of a command comes from the system file that was read at the
start, never from the agent.
"""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any

from msgspec import Meta

from fieldtwin.gateway.core.concurrency.async_resource import AsyncResource
from fieldtwin.gateway.core.concurrency.nursery import Nursery
from fieldtwin.gateway.core.errors import CheckFailed, FieldtwinError, NotAllowed, UsageError
from fieldtwin.gateway.devices.config import BusConfig, DeviceConfig
from fieldtwin.gateway.runtime.audit_log import AuditLog
from fieldtwin.studio.commissioning.jobs import FAILED, STOPPED, Job, Jobs
from fieldtwin.studio.commissioning.steps import Command, Step
from fieldtwin.studio.commissioning.work_folder import WorkFolder
from fieldtwin.twin.site.system import System

LONGEST_S = 3_600.0
"""Time in seconds after which a command is stopped."""
MOST_ITEMS = 50
Item = Annotated[str, Meta(max_length=80, pattern=r"^[A-Za-z0-9_*?][A-Za-z0-9_*?:.\-\[\]]*$")]
Items = Annotated[list[Item], Meta(max_length=MOST_ITEMS)]


class ReadDevice(Step, tag="read"):
    """Read values of a device of a system once. With no `items` all tags of its profile are read."""

    endpoint: str
    address: int
    profile: str
    is_can: bool
    echo: bool
    items: Items

    def command(self, folder: WorkFolder) -> Command:
        """Return the command line."""
        address = ["--node" if self.is_can else "--unit", str(self.address), f"--profile={self.profile}"]
        arguments = ["read", self.endpoint, *self.items, *address, *(["--echo"] if self.echo else [])]
        return Command(tuple(arguments), port=self.endpoint)


class DeviceJobs(AsyncResource):
    """The commands of one agent for the devices of `systems`. Leaving the block stops those that run."""

    def __init__(self, systems: Mapping[str, System], folder: Path, audit: AuditLog, by: str) -> None:
        super().__init__()
        self._systems = systems
        self._jobs = Jobs(WorkFolder(folder), LONGEST_S)
        self._audit = audit
        self._by = by
        self._nursery = Nursery()

    async def _start(self) -> None:
        await self._stack.enter_async_context(self._nursery)
        await self._stack.enter_async_context(self._jobs)

    def system(self, name: str) -> System:
        """Return a system whose buses the agent may open. Raises `NotAllowed`."""
        if name not in self._systems:
            raise NotAllowed(
                f"this agent may not open the buses of the system {name[:60]!r}",
                expected=", ".join(sorted(self._systems)) or "a system that the user has enabled; none is",
                hint="the user enables it with: fieldtwin mcp --allow-devices SYSTEM",
            )
        return self._systems[name]

    def bus(self, system: str, bus: str) -> BusConfig:
        """Return a bus of an enabled system. Raises `NotAllowed` or `UsageError`."""
        buses = self.system(system).buses
        if bus not in buses:
            raise UsageError(f"the system {system} has no bus {bus[:60]!r}", expected=", ".join(buses))
        return buses[bus]

    def device(self, system: str, device: str) -> DeviceConfig:
        """Return a device of an enabled system. Raises `NotAllowed` or `UsageError`."""
        devices = self.system(system).devices
        if device not in devices:
            raise UsageError(f"the system {system} has no device {device[:60]!r}", expected=", ".join(devices))
        return devices[device]

    async def start(self, step: Step) -> Job:
        """Start a command. Raises `EndpointBusy` if another one uses the bus, and `UsageError` for too many."""
        job = await self._jobs.start(step)
        self._nursery.start(self._record_end(job), f"end of job {job.number}")
        return job

    async def result(self, step: Step) -> Any:
        """Run a command to its end, and return its result. It is stopped if the call is cancelled.

        Raises `CheckFailed` with the messages of a command without a result.
        """
        job = await self.start(step)
        try:
            await job.wait()
        except BaseException:
            await job.stop()
            raise
        whole = job.whole()
        if whole["result"] is None or whole["state"] in (FAILED, STOPPED):
            raise CheckFailed(whole["trouble"] or " ".join(whole["lines"][-3:]) or f"{job.step} ended without a result")
        return whole["result"]

    def job(self, number: int) -> Job:
        """Return a command that was started. Raises `UsageError` for an unknown number."""
        job = self._jobs.job(number)
        if job is None:
            numbers = ", ".join(str(each["number"]) for each in self._jobs.overview()[-10:])
            raise UsageError(f"no job {number}", expected=numbers or "none was started")
        return job

    async def _record_end(self, job: Job) -> None:
        await job.wait()
        try:
            self._audit.note("job", "", by=self._by, result=job.state()["state"], number=job.number, tool=job.step)
        except FieldtwinError:
            return  # the call that started the job is recorded, and no further call is carried out without a record


async def wait_for(job: Job, seconds: float) -> None:
    """Wait for the end of a job, at most some seconds."""
    with suppress(TimeoutError):
        async with asyncio.timeout(seconds):
            await job.wait()
