"""An agent and a running plant: it reads the plant only if the user has enabled that, and 1,000 random calls change nothing."""

from __future__ import annotations

import asyncio
import random
from collections import Counter
from pathlib import Path
from typing import Any

import pytest
from agent_site import SCENARIO, Agent, Failed, agent, write_project
from emulated_plant import COMMISSIONING_READS, READ_DIAGNOSTICS, plant, registers
from mcp_types import TextContent

pytestmark = [pytest.mark.long, pytest.mark.timeout(900)]
CALLS = 1_000
SEED = 20_261_128


def test_a_plant_is_read_only_if_it_is_enabled_and_unknown_otherwise(tmp_path: Path) -> None:
    project = write_project(tmp_path)

    async def work() -> None:
        async with plant(tmp_path, project):
            async with agent(tmp_path, project) as one:
                assert await one.data("list_instances") == []
                with pytest.raises(Failed, match="fieldtwin mcp --plant shed"):
                    await one.data("read_tags", instance="shed")
            async with agent(tmp_path, project, "--plant", "shed") as one:
                [found] = await one.data("list_instances")
                assert (found["mode"], found["may_operate"]) == ("plant", False)
                waited = await one.data("wait_for_tag", instance="shed", tag="tank.level", quality="good", seconds=30)
                assert waited["reached"]
                assert (await one.data("why", instance="shed", tag="tank.level"))["device"]["tank"]["online"]
                with pytest.raises(Failed, match="a plant is read-only for agents"):
                    await one.data("set_value", instance="shed", tag="tank.valve", value=1)

    asyncio.run(work())


def test_a_thousand_random_calls_change_nothing_on_a_plant(tmp_path: Path) -> None:
    project = write_project(tmp_path)

    async def work() -> tuple[Counter[str], Counter[str]]:
        enabled = ("--plant", "shed", "--allow-proposals", "shed", "--allow-devices", str(project / "shed.yaml"))
        async with plant(tmp_path, project) as (_, bus, port), agent(tmp_path, project, *enabled) as one:
            await one.data("wait_for_tag", instance="shed", tag="tank.valve", quality="good", seconds=30)
            before = await asyncio.to_thread(registers, port)
            files = contents(project)
            audited = (tmp_path / "shed" / "audit.jsonl").read_bytes()
            forces = (await one.data("get_status", instance="shed"))["plc"]
            called, failed = await random_calls(one)
            assert await asyncio.to_thread(registers, port) == before
            assert (tmp_path / "shed" / "audit.jsonl").read_bytes() == audited
            assert (await one.data("get_status", instance="shed"))["plc"] == forces
            after = contents(project)
            assert {name: after.get(name) for name in files} == files
            assert all(name.endswith((".scenario.yaml", ".jsonl")) for name in after.keys() - files.keys())
            assert set(bus.requests) <= COMMISSIONING_READS, bus.requests
            assert bus.diagnostics <= READ_DIAGNOSTICS
            assert sum(bus.requests.values()) > 10
            return called, failed

    called, failed = asyncio.run(work())
    assert sum(called.values()) == CALLS
    assert len(called) > 20
    assert CALLS // 10 < sum(failed.values()) < CALLS


def contents(folder: Path) -> dict[str, bytes]:
    """The files of the project."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


async def random_calls(one: Agent) -> tuple[Counter[str], Counter[str]]:
    """Make random calls of all tools, and return the number of calls and of errors by tool."""
    rng = random.Random(SEED)
    tools = {tool.name: tool.input_schema for tool in (await one.client.list_tools()).tools}
    called: Counter[str] = Counter()
    failed: Counter[str] = Counter()
    for _ in range(CALLS):
        name = rng.choice([*tools, "write_tag", "approve"])
        properties = tools.get(name, {}).get("properties", {"tag": {}, "value": {}})
        given = {key: value_for(key, rng) for key in properties if rng.random() < 0.95}
        result = await one.client.session.call_tool(name, given)
        called[name] += 1
        content = result.content[0]
        assert isinstance(content, TextContent)
        assert "Bug:" not in content.text, (name, given, content.text)
        failed[name] += result.is_error
    return called, failed


VALUES: dict[str, list[Any]] = {
    "instance": ["shed", "shed", "shed", "shed", "agent-shed", "../shed", ""],
    "tag": ["tank.level", "tank.valve", "tank.valve", "tank.none", "level", ""],
    "tags": [["tank.valve"], [], ["x"]],
    "value": [0, 1, 1, 1e9, -1.5, True, None],
    "fault": [{"name": "silence", "device": "tank"}, {"name": "set", "device": "tank"}, {}, {"name": 5}],
    "system": ["shed.yaml", "nothing.yaml", "../shed.yaml", "tank.yaml", "shed", "shed"],
    "device": ["tank", "tank", "pump", "--log=x"],
    "bus": ["lan", "lan", "wan", "tcp://127.0.0.1:502"],
    "items": [["valve"], [], ["holding:0"], ["--log=x"], ["x"]],
    "address": [1, 2, -1, 300],
    "addresses": ["1", "1-2", "--all", "x"],
    "ranges": [["holding:0..1"], ["--out=x"], [5]],
    "passes": [1, 0, 10**6],
    "job": [1, 2, 3, 0, -1],
    "proposal": [1, 2, 3, 0, -1],
    "reason": ["why not", "", "x" * 300, "\x1b[2J"],
    "path": [
        "shed.yaml",
        "silent.scenario.yaml",
        "../x",
        "d.jsonl",
        "e.jsonl",
        "x.scenario.yaml",
        "tank.yaml",
        "shed.prototype.yaml",
    ],
    "text": [SCENARIO, "scenario: x", "", "{", SCENARIO.replace("tank.level", "tank.valve")],
    "words": ["stale", "timeout", "exception 02", "?", ""],
    "quality": ["good", "bad", ""],
    "seconds": [0, 0.01, 0.02, -1, 1e12],
    "points": [4, 200, 0, 10**9],
    "offset": [0, 10, -1, 10**9],
    "result": [1, 2, 0, -1],
}


def value_for(key: str, rng: random.Random) -> Any:
    """A value for an argument: mostly one that fits its name, sometimes any."""
    if key not in VALUES or rng.random() < 0.1:
        return rng.choice([None, 0, "x", [], {}, True, 1e300, "\u0000", [[1]], {"a": {"b": 1}}])
    return rng.choice(VALUES[key])
