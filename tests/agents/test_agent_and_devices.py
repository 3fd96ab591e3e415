"""An agent reads devices directly: only on the buses of a system that the user has enabled, and without any write."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest
from agent_site import Agent, Failed, agent, write_project
from emulated_plant import COMMISSIONING_READS, READ_DIAGNOSTICS, Bus, emulated_device, registers

pytestmark = [pytest.mark.long, pytest.mark.timeout(600)]


@asynccontextmanager
async def commissioning(root: Path) -> AsyncIterator[tuple[Agent, Path, Bus, int]]:
    """A device on a socket, and an agent that may open the bus of its system. No run exists."""
    project = write_project(root)
    enabled = ("--allow-devices", str(project / "shed.yaml"))
    async with emulated_device(root, project) as (bus, port), agent(root, project, *enabled) as one:
        yield one, project, bus, port


async def ended(one: Agent, job: int) -> dict[str, Any]:
    while (found := await one.data("get_job", job=job, seconds=5))["state"] == "running":
        pass
    assert isinstance(found, dict)
    return found


def test_an_agent_reads_identifies_scans_and_dumps_a_device(tmp_path: Path) -> None:
    async def work() -> None:
        async with commissioning(tmp_path) as (one, project, bus, port):
            before = await asyncio.to_thread(registers, port)
            read = await one.data("read_device", system="shed", device="tank")
            assert {row["name"]: row["value"] for row in read["values"]} == {"level": 0, "valve": 0}
            raw = await one.data("read_device", system="shed", device="tank", items=["input:0"])
            assert [row["value"] for row in raw["values"]] == [0]
            assert (await one.data("identify_device", system="shed", bus="lan"))["answers"]

            scan = await ended(one, (await one.data("start_scan", system="shed", bus="lan", addresses="1-3"))["job"])
            assert scan["state"] in ("done", "findings"), scan
            assert "1" in json.dumps(scan["result"])
            dump = {"system": "shed", "bus": "lan", "path": "tank.jsonl", "ranges": ["holding:0..3"]}
            assert (await ended(one, (await one.data("start_dump", **dump))["job"]))["state"] in ("done", "findings")
            assert (project / "tank.jsonl").read_text().startswith('{"fieldtwin_dump"')
            with pytest.raises(Failed, match="already exists"):
                await one.data("start_dump", **dump)

            assert await asyncio.to_thread(registers, port) == before
            assert set(bus.requests) <= COMMISSIONING_READS, bus.requests
            assert bus.diagnostics <= READ_DIAGNOSTICS
            jobs = [entry for entry in one.entries() if entry["action"] == "job"]
            assert [entry["tool"] for entry in jobs] == ["read", "read", "identify", "scan", "dump"]

    asyncio.run(work())


def test_a_long_job_is_stopped(tmp_path: Path) -> None:
    async def work() -> None:
        async with commissioning(tmp_path) as (one, _, _, _):
            job = (await one.data("start_scan", system="shed", bus="lan"))["job"]
            with pytest.raises(Failed, match="uses this port"):
                await one.data("start_scan", system="shed", bus="lan")
            assert (await one.data("stop_job", job=job))["state"] == "stopped"
            with pytest.raises(Failed, match="no job 99"):
                await one.data("stop_job", job=99)

    asyncio.run(work())


def test_other_buses_and_options_of_commands_are_refused(tmp_path: Path) -> None:
    async def work() -> None:
        async with commissioning(tmp_path) as (one, _, bus, _):
            for tool, given, message in (
                ("read_device", {"system": "observatory", "device": "ctd"}, "fieldtwin mcp --allow-devices"),
                ("read_device", {"system": "shed", "device": "pump"}, "no device 'pump'; expected tank"),
                ("read_device", {"system": "shed", "device": "tank", "items": ["--log=/tmp/x"]}, "arguments"),
                ("identify_device", {"system": "shed", "bus": "tcp://127.0.0.1:1"}, "no bus"),
                ("identify_device", {"system": "shed", "bus": "lan", "address": 300}, "arguments"),
                ("start_scan", {"system": "shed", "bus": "lan", "addresses": "1 --all"}, "arguments"),
                ("start_dump", {"system": "shed", "bus": "lan", "path": "../x.jsonl"}, "plain name"),
                ("start_dump", {"system": "shed", "bus": "lan", "path": "x.yaml"}, r"ends with \.jsonl"),
                ("start_dump", {"system": "shed", "bus": "lan", "path": "x.jsonl", "passes": 101}, "arguments"),
            ):
                with pytest.raises(Failed, match=message):
                    await one.data(tool, **given)
            assert not bus.requests

    asyncio.run(work())


def test_no_bus_is_opened_unless_the_user_has_enabled_it(tmp_path: Path) -> None:
    project = write_project(tmp_path)

    async def work() -> None:
        async with emulated_device(tmp_path, project) as (bus, _), agent(tmp_path, project) as one:
            for tool, given in (
                ("read_device", {"device": "tank"}),
                ("identify_device", {"bus": "lan"}),
                ("start_scan", {"bus": "lan"}),
                ("start_dump", {"bus": "lan", "path": "x.jsonl"}),
            ):
                with pytest.raises(Failed, match="may not open the buses"):
                    await one.data(tool, system="shed", **given)
            assert not bus.requests

    asyncio.run(work())
