"""Tools for scenarios: save a new one, and run one in virtual time."""

from __future__ import annotations

import asyncio
from typing import Any

import msgspec

from fieldtwin.agents.project import read_text
from fieldtwin.agents.tool import Tool
from fieldtwin.agents.tools.knowledge import OfFile, scenario_of
from fieldtwin.agents.workplace import Workplace

RUNS_WITHIN_S = 600.0
LOOK_EVERY_S = 0.1


class SaveScenario(msgspec.Struct, forbid_unknown_fields=True):
    """The path of a new file, with the suffix .scenario.yaml or without it, and its text."""

    path: str
    text: str


async def save_scenario(work: Workplace, given: SaveScenario) -> dict[str, Any]:
    """Write a new scenario. A scenario with errors and an existing file are refused."""
    await asyncio.to_thread(scenario_of, work, given.text, given.path)
    path = await asyncio.to_thread(work.project.save_scenario, given.path, given.text)
    return {"path": work.project.name_of(path)}


async def run_scenario(work: Workplace, given: OfFile) -> dict[str, Any]:
    """Run a scenario of the project in virtual time and return its verdict, with the steps and checks."""
    path = work.project.inside(given.path)
    await asyncio.to_thread(lambda: scenario_of(work, read_text(path), given.path))
    await work.runner.start(str(path), "virtual")
    try:
        while (state := work.runner.state()) is not None and state["running"]:
            await asyncio.sleep(LOOK_EVERY_S)
    except BaseException:
        await work.runner.stop()
        raise
    assert state is not None
    name = work.project.name_of(path)
    return {
        "trouble": state["trouble"],
        "result": state["result"],
        "took_s": round(state["elapsed_s"], 3),
        "report": "fieldtwin://report/latest" if state["report"] else "",
        "repeat": f"fieldtwin test {name}",
    }


TOOLS = (
    Tool("save_scenario", "Save a new scenario file in the project.", save_scenario, SaveScenario, "project"),
    Tool("run_scenario", "Run a scenario of the project in virtual time.", run_scenario, OfFile, "", RUNS_WITHIN_S),
)
