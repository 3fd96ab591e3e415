"""An agent performs the tasks of a test engineer: over stdio, with the client of the package mcp and the real server."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Awaitable, Callable
from pathlib import Path

import pytest
from agent_site import SCENARIO, Agent, Failed, agent, write_project
from mcp.shared.exceptions import MCPError

pytestmark = [pytest.mark.long, pytest.mark.timeout(300)]
TAG = "tank.level"


def test_an_agent_performs_ten_tasks(tmp_path: Path) -> None:
    project = write_project(tmp_path)

    async def work() -> None:
        async with agent(tmp_path, project) as one:
            for task in (
                learns_what_the_project_contains,
                checks_and_draws_the_system,
                reads_documentation_profiles_and_schemas,
                starts_the_prototype_and_reads_good_values,
                reproduces_a_bad_value_and_finds_its_cause,
                sees_the_fault_in_the_history,
                sets_a_value_in_a_simulated_device,
                corrects_and_saves_a_scenario,
                runs_the_scenario_and_reads_its_report,
                stops_the_prototype,
            ):
                await task(one)
            calls = [entry for entry in one.entries() if entry["result"] == "asked"]
            ends = [entry for entry in one.entries() if entry["result"] != "asked"]
            assert len(calls) == len(ends) > 25
            assert {entry["by"] for entry in calls} == {"agent over stdio"}
            assert any(entry["tool"] == "inject_fault" and "silence" in entry["arguments"] for entry in calls)

    asyncio.run(work())
    assert (project / "silent.scenario.yaml").read_text() == SCENARIO


async def learns_what_the_project_contains(one: Agent) -> None:
    found = await one.data("list_files")
    assert {"path": "shed.yaml", "kind": "system or profile"} in found["files"]
    assert "observatory" in found["shipped_systems"]
    assert "system: shed" in await one.text("read_file", path="shed.yaml")


async def checks_and_draws_the_system(one: Agent) -> None:
    assert await one.data("check_system", system="shed.yaml", prototype=True) == {"ok": True, "errors": []}
    drawn = await one.text("draw_system", system="shed.yaml")
    assert "tank  unit 1  own/tank" in drawn
    assert "ctd" in await one.text("draw_system", system="observatory", prototype=True)


async def reads_documentation_profiles_and_schemas(one: Agent) -> None:
    uris = {resource.uri for resource in (await one.client.list_resources()).resources}
    assert {"fieldtwin://schema/scenario", "fieldtwin://profile/ctd-reference"} <= uris
    assert "fieldtwin://docs/how-to/faults.md" in uris
    first = await one.resource("fieldtwin://schema/scenario")
    assert first.startswith("{")
    assert "protocol: modbus" in await one.resource("fieldtwin://project/tank.yaml")
    [stale] = await one.data("explain", words="stale")
    assert stale["todo"]
    faults = {fault["name"] for fault in await one.data("list_faults")}
    assert {"silence", "late-reply"} <= faults


async def starts_the_prototype_and_reads_good_values(one: Agent) -> None:
    assert await one.data("start_prototype", system="shed.yaml") == {"instance": "agent-shed"}
    [running] = await one.data("list_instances")
    assert (running["mode"], running["may_operate"]) == ("prototype", True)
    waited = await one.data("wait_for_tag", instance="agent-shed", tag=TAG, quality="good", seconds=30)
    assert (waited["reached"], waited[TAG]["value"]) == (True, 20)
    assert (await one.data("get_status", instance="agent-shed"))["devices"]["tank"]["online"]


async def reproduces_a_bad_value_and_finds_its_cause(one: Agent) -> None:
    fault = {"id": "dead", "name": "silence", "device": "tank"}
    injected = await one.data("inject_fault", instance="agent-shed", fault=fault)
    assert injected["id"] == "dead"
    waited = await one.data("wait_for_tag", instance="agent-shed", tag=TAG, quality="bad", seconds=30)
    assert waited["reached"]
    found = await one.data("why", instance="agent-shed", tag=TAG)
    assert (found["tag"][TAG]["quality"], found["tag"][TAG]["reason"]) == ("bad", "timeout")
    assert any("timeout" in each["word"] and each["what_to_do"] for each in found["explanation"])
    assert [active["id"] for active in found["active_faults"]] == ["dead"]
    assert (await one.data("list_active_faults", instance="agent-shed"))["active"][0]["name"] == "silence"
    assert await one.data("clear_faults", instance="agent-shed") == {"cleared": ["dead"]}
    assert (await one.data("wait_for_tag", instance="agent-shed", tag=TAG, quality="good", seconds=30))["reached"]


async def sees_the_fault_in_the_history(one: Agent) -> None:
    async def is_complete() -> bool:
        changes = (await one.data("get_history", instance="agent-shed", tag=TAG))["changes"]
        qualities = [quality for _, _, quality, _ in changes]
        return "bad" in qualities and qualities[-1] == "good"

    await until(is_complete)


async def sets_a_value_in_a_simulated_device(one: Agent) -> None:
    await one.data("set_value", instance="agent-shed", tag=TAG, value=77)

    async def is_read() -> bool:
        return bool((await one.data("read_tags", instance="agent-shed", tags=[TAG]))[TAG]["value"] == 77)

    await until(is_read)
    await one.data("set_value", instance="agent-shed", tag=TAG, value=None)


async def corrects_and_saves_a_scenario(one: Agent) -> None:
    wrong = SCENARIO.replace("name: silence", "name: silense")
    checked = await one.data("check_scenario", text=wrong)
    assert not checked["ok"]
    assert "silence" in checked["errors"][0]
    with pytest.raises(Failed, match="silense"):
        await one.data("save_scenario", path="silent", text=wrong)
    assert (await one.data("check_scenario", text=SCENARIO))["ok"]
    assert await one.data("save_scenario", path="silent", text=SCENARIO) == {"path": "silent.scenario.yaml"}
    with pytest.raises(Failed, match="exists already"):
        await one.data("save_scenario", path="silent", text=SCENARIO)


async def runs_the_scenario_and_reads_its_report(one: Agent) -> None:
    ran = await one.data("run_scenario", path="silent.scenario.yaml")
    assert ran["result"]["verdict"] == "passed", ran
    assert ran["repeat"] == "fieldtwin test silent.scenario.yaml"
    page = await one.resource(ran["report"])
    assert "The level is bad while the tank does not answer" in await whole(one, page)


async def stops_the_prototype(one: Agent) -> None:
    assert await one.data("stop_prototype", instance="agent-shed") == {"stopped": "agent-shed"}
    assert await one.data("list_instances") == []
    with pytest.raises(Failed, match="may not read the instance"):
        await one.data("read_tags", instance="agent-shed")


async def whole(one: Agent, text: str) -> str:
    """The whole of a long result, of which `text` is the first part."""
    found = ""
    while True:
        part, _, note = text.rpartition("\n[characters ")
        if not note.endswith(")]"):
            return found + text
        found += part
        call = note.rpartition("read_rest(")[2].removesuffix(")]")
        arguments = {name: int(value) for name, value in (pair.split("=") for pair in call.split(", "))}
        text = await one.text("read_rest", **arguments)


async def until(condition: Callable[[], Awaitable[bool]], within_s: float = 30.0) -> None:
    async with asyncio.timeout(within_s):
        while not await condition():
            await asyncio.sleep(0.05)


def test_an_agent_cannot_leave_the_project_or_operate_what_it_did_not_start(tmp_path: Path) -> None:
    project = write_project(tmp_path)
    (tmp_path / "outside.yaml").write_text("fieldtwin: 1\n")
    (project / "link.yaml").symlink_to(tmp_path / "outside.yaml")
    (project / ".env.yaml").write_text("secret")
    (project / "token").write_text("secret")
    (project / "open.yaml").write_text((project / "shed.yaml").read_text().replace("system: shed", "system: open"))
    shown = (project / "shed.prototype.yaml").read_text().replace("shed.yaml", "open.yaml")
    (project / "open.prototype.yaml").write_text(shown.replace("127.0.0.1", "0.0.0.0"))
    (tmp_path / "elsewhere").mkdir()
    for file in project.glob("*.*"):
        if file.is_file() and not file.is_symlink():
            (tmp_path / "elsewhere" / file.name).write_bytes(file.read_bytes())

    async def work() -> None:
        async with agent(tmp_path, project) as one:
            for path in ("../outside.yaml", "/etc/passwd", "link.yaml", ".env.yaml", "token", "a\0b", "nothing.yaml"):
                with pytest.raises(Failed):
                    await one.text("read_file", path=path)
            for uri in ("fieldtwin://project/../outside.yaml", "fieldtwin://project/token", "file:///etc/passwd"):
                with pytest.raises(MCPError):
                    await one.resource(uri)
            with pytest.raises(Failed, match="outside of the project"):
                await one.data("save_scenario", path="../s", text=SCENARIO)
            other = SCENARIO.replace("system: shed.yaml", "system: ../elsewhere/shed.yaml")
            assert "outside of the project" in (await one.data("check_scenario", text=other))["errors"][0]
            other = SCENARIO.replace("shed.yaml\n", "shed.yaml\nprototype: ../elsewhere/shed.prototype.yaml\n")
            assert "the prototype is outside" in (await one.data("check_scenario", text=other))["errors"][0]
            with pytest.raises(Failed, match=r"0\.0\.0\.0, where other computers can reach it"):
                await one.data("start_prototype", system="open.yaml")
            for tool, arguments in (
                ("read_tags", {}),
                ("inject_fault", {"fault": {"name": "silence"}}),
                ("set_value", {"tag": TAG, "value": 1}),
                ("stop_prototype", {}),
            ):
                with pytest.raises(Failed, match="NotAllowed"):
                    await one.data(tool, instance="shed", **arguments)
            with pytest.raises(Failed, match="no tool 'write_tag'"):
                await one.data("write_tag", tag=TAG, value=1)
            with pytest.raises(Failed, match="expected instance, tag"):
                await one.data("why", instance="shed", tag=TAG, more=1)

    asyncio.run(work())


def test_a_prototype_ends_with_its_agent(tmp_path: Path) -> None:
    project = write_project(tmp_path)

    async def work() -> None:
        async with agent(tmp_path, project) as one:
            await one.data("start_prototype", system="shed.yaml")

    asyncio.run(work())
    record = json.loads((tmp_path / "agent-shed" / "run.json").read_text())
    assert not Path(f"/proc/{record['pid']}").exists()
