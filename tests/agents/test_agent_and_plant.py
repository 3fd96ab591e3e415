"""An agent and a running plant: it reads the plant only if the user has enabled that, and 1,000 random calls change nothing."""

from __future__ import annotations

import asyncio
import random
from collections import Counter
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest
from agent_site import SCENARIO, Agent, Failed, agent, write_project
from mcp_types import TextContent
from procs import Fieldtwin, fieldtwin, free_port, wait_for
from pyModbusTCP.client import ModbusClient

pytestmark = [pytest.mark.long, pytest.mark.timeout(900)]
CALLS = 1_000
SEED = 20_261_128
WITHIN_S = 60.0
READS = {1, 2, 3, 4, 0x2B}
"""Function codes of Modbus requests that change nothing."""


class Bus:
    """A relay between the gateway and the emulated device, which counts the requests by function code."""

    def __init__(self, device_port: int) -> None:
        self.requests: Counter[int] = Counter()
        self._device_port = device_port

    @asynccontextmanager
    async def serving(self) -> AsyncIterator[int]:
        server = await asyncio.start_server(self._serve, "127.0.0.1", 0)
        try:
            yield server.sockets[0].getsockname()[1]
        finally:
            server.close()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        device_reader, device_writer = await asyncio.open_connection("127.0.0.1", self._device_port)
        back = asyncio.ensure_future(self._pass_back(device_reader, writer))
        try:
            while True:
                header = await reader.readexactly(6)
                body = await reader.readexactly(int.from_bytes(header[4:6], "big"))
                self.requests[body[1]] += 1
                device_writer.write(header + body)
        except (asyncio.IncompleteReadError, ConnectionError):
            pass
        finally:
            back.cancel()
            device_writer.close()
            writer.close()

    async def _pass_back(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        while data := await reader.read(4096):
            writer.write(data)


def registers(port: int) -> list[list[int]]:
    """The registers that the device holds, read by a different client."""
    client = ModbusClient("127.0.0.1", port, unit_id=1, auto_open=True, auto_close=True)
    return [client.read_input_registers(0, 1) or [], client.read_holding_registers(0, 1) or []]


@asynccontextmanager
async def plant(root: Path, project: Path) -> AsyncIterator[tuple[Fieldtwin, Bus, int]]:
    """The site as a plant that allows writes, against an emulated device on a socket."""
    port = free_port()
    bus = Bus(port)
    with fieldtwin(
        root, "emulate", str(project / "tank.yaml"), "--on", f"tcp://127.0.0.1:{port}", name="emulate"
    ) as device:
        wait_for(lambda: str(port) in device.out + device.err, WITHIN_S, "the emulated device")
        async with bus.serving() as relay:
            system = project / "shed.yaml"
            system.write_text(system.read_text().replace("tank:502", f"127.0.0.1:{relay}"))
            with fieldtwin(root, "run", str(system), "--plant", "--allow-writes") as run:
                await asyncio.to_thread(wait_for, (root / "shed" / "gateway.sock").is_socket, WITHIN_S, "the gateway")
                yield run, bus, port


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
        async with plant(tmp_path, project) as (_, bus, port), agent(tmp_path, project, "--plant", "shed") as one:
            await one.data("wait_for_tag", instance="shed", tag="tank.valve", quality="good", seconds=30)
            before = await asyncio.to_thread(registers, port)
            audited = (tmp_path / "shed" / "audit.jsonl").read_bytes()
            forces = (await one.data("get_status", instance="shed"))["plc"]
            called, failed = await random_calls(one)
            assert await asyncio.to_thread(registers, port) == before
            assert (tmp_path / "shed" / "audit.jsonl").read_bytes() == audited
            assert (await one.data("get_status", instance="shed"))["plc"] == forces
            assert set(bus.requests) <= READS, bus.requests
            assert sum(bus.requests.values()) > 10
            return called, failed

    called, failed = asyncio.run(work())
    assert sum(called.values()) == CALLS
    assert len(called) > 20
    assert CALLS // 10 < sum(failed.values()) < CALLS


async def random_calls(one: Agent) -> tuple[Counter[str], Counter[str]]:
    """Make random calls of all tools, and return the number of calls and of errors by tool."""
    rng = random.Random(SEED)
    tools = {tool.name: tool.input_schema for tool in (await one.client.list_tools()).tools}
    called: Counter[str] = Counter()
    failed: Counter[str] = Counter()
    for _ in range(CALLS):
        name = rng.choice([*tools, "write_tag"])
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
    "system": ["shed.yaml", "nothing.yaml", "../shed.yaml", "tank.yaml"],
    "path": ["shed.yaml", "silent.scenario.yaml", "../x", "x.scenario.yaml", "tank.yaml", "shed.prototype.yaml"],
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
