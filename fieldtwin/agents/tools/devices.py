"""Tools that open the buses of a system to read its devices. None of them writes to a device."""

from __future__ import annotations

from typing import Annotated, Any

import msgspec
from msgspec import Meta

from fieldtwin.agents.device_jobs import Items, ReadDevice, wait_for
from fieldtwin.agents.tool import Tool
from fieldtwin.agents.tools.instances import check_wait
from fieldtwin.agents.workplace import Workplace
from fieldtwin.studio.commissioning.steps import Address, Dump, File, Identify, Numbers, Range, Scan

READS_WITHIN_S = 120.0


class OfDevice(msgspec.Struct, forbid_unknown_fields=True):
    """A device of an enabled system, and tags of its profile or addresses such as ``holding:100``; without `items` all tags."""

    system: str
    device: str
    items: Items = []


class OfBusAddress(msgspec.Struct, forbid_unknown_fields=True):
    """A bus of an enabled system, and a unit ID or node ID."""

    system: str
    bus: str
    address: Address = 1


class OfScan(msgspec.Struct, forbid_unknown_fields=True):
    """A bus of an enabled system, and unit IDs or node IDs such as ``1-20,30``; empty means all."""

    system: str
    bus: str
    addresses: Numbers = ""


class OfDump(msgspec.Struct, forbid_unknown_fields=True):
    """A bus of an enabled system, a unit ID or node ID, ranges such as ``holding:0..99``, and the name of a new .jsonl file."""

    system: str
    bus: str
    path: File
    address: Address = 1
    ranges: Annotated[list[Range], Meta(max_length=20)] = []
    passes: Annotated[int, Meta(ge=1, le=100)] = 1


class OfJob(msgspec.Struct, forbid_unknown_fields=True):
    """The number of a job, as start_scan and start_dump return it."""

    job: int


class WaitForJob(msgspec.Struct, forbid_unknown_fields=True):
    """The number of a job, and the time for which to wait for its end."""

    job: int
    seconds: float = 0.0


async def read_device(work: Workplace, given: OfDevice) -> Any:
    """Return values of a device, with the reason for each that cannot be read."""
    device = work.devices.device(given.system, given.device)
    bus = work.devices.bus(given.system, device.bus)
    step = ReadDevice(
        endpoint=str(bus.endpoint),
        address=device.address,
        profile=str(device.profile.path),
        is_can=bus.endpoint.is_can,
        echo=bus.echo,
        items=given.items,
    )
    return await work.devices.result(step)


async def identify_device(work: Workplace, given: OfBusAddress) -> Any:
    """Return the identification of a device, and the profiles that fit."""
    bus = work.devices.bus(given.system, given.bus)
    return await work.devices.result(Identify(endpoint=str(bus.endpoint), address=given.address))


async def start_scan(work: Workplace, given: OfScan) -> dict[str, Any]:
    """Start to find the devices on a bus, and return the number of the job."""
    bus = work.devices.bus(given.system, given.bus)
    job = await work.devices.start(Scan(endpoint=str(bus.endpoint), units=given.addresses))
    return {"job": job.number, "command": job.command.line}


async def start_dump(work: Workplace, given: OfDump) -> dict[str, Any]:
    """Start to read the registers or objects of a device into a file, and return the number of the job."""
    bus = work.devices.bus(given.system, given.bus)
    step = Dump(
        endpoint=str(bus.endpoint), out=given.path, address=given.address, ranges=given.ranges, passes=given.passes
    )
    job = await work.devices.start(step)
    return {"job": job.number, "command": job.command.line}


async def get_job(work: Workplace, given: WaitForJob) -> dict[str, Any]:
    """Return the state, the messages and, at its end, the result of a job."""
    check_wait(given.seconds)
    job = work.devices.job(given.job)
    await wait_for(job, given.seconds)
    return job.whole()


async def stop_job(work: Workplace, given: OfJob) -> dict[str, Any]:
    """Stop a job as Ctrl-C does. Its files so far are kept."""
    job = work.devices.job(given.job)
    await job.stop()
    return job.whole()


TOOLS = (
    Tool(
        "read_device",
        "Read values of a device of an enabled system, without a running system.",
        read_device,
        OfDevice,
        within_s=READS_WITHIN_S,
    ),
    Tool(
        "identify_device",
        "Read the identification of a device of an enabled system.",
        identify_device,
        OfBusAddress,
        within_s=READS_WITHIN_S,
    ),
    Tool(
        "start_scan",
        "Start to find the devices on a bus of an enabled system; get_job has the result.",
        start_scan,
        OfScan,
    ),
    Tool(
        "start_dump",
        "Start to read all registers or objects of a device into a new file; get_job has the result.",
        start_dump,
        OfDump,
        "project",
    ),
    Tool(
        "get_job", "Read the progress and the result of a job, or wait for its end at most 30 s.", get_job, WaitForJob
    ),
    Tool("stop_job", "Stop a job that you have started.", stop_job, OfJob),
)
