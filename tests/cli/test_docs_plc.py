"""The examples of the pages about the PLC run: programs, a proof, commands."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

from st_bench import program
from st_bench import scan as st_scan

from fieldtwin.cli.plc.plc_command import command
from fieldtwin.plc.program import Role, ScanInfo
from fieldtwin.plc.prove import prove

DOCS = Path(__file__).parents[2] / "docs"
PAGES = ("reference/plc.md", "how-to/state-machines.md", "reference/structured-text.md", "how-to/debug-plc.md")
PAGE = "".join((DOCS / page).read_text(encoding="utf-8") for page in PAGES)
MS = 1_000_000


def snippets(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", PAGE, re.DOTALL | re.MULTILINE)


def python() -> dict[str, Any]:
    """Return all Python code of the pages, in order, as one module."""
    space: dict[str, Any] = {"__name__": "docs_plc"}
    for text in snippets("python"):
        exec(compile(text, "docs", "exec"), space)
    return space


def test_the_pump_starts_counts_and_warns() -> None:
    pump = python()["Pump"]()
    assert {v.name: (v.role, v.retain) for v in pump.variables.values()} == {
        "level": (Role.INPUT, False), "run": (Role.OUTPUT, False), "high": (Role.LOCAL, False), "starts": (Role.LOCAL, True),
    }  # fmt: skip

    def at(ms: int, level: float | None) -> tuple[bool, bool, int]:
        pump.level = level
        pump.execute(ScanInfo(ms * MS, ms, ms == 0))
        return pump.run, pump.high, pump.starts

    assert at(0, None) == (False, False, 0)
    assert [at(10, 15.0)[0], at(500, 15.0)[0], at(510, 15.0)[0]] == [False, False, True]
    assert at(520, 85.0) == (False, False, 1)
    assert at(2520, 85.0) == (False, True, 1)


def test_the_machine_fills_and_is_proved() -> None:
    space = python()
    result = prove(space["PROOF"])
    assert result.proved
    assert result.states >= 6
    leaky = type("Leaky", (space["Filling"],), {"close": lambda self: None})
    assert prove(replace(space["PROOF"], make=leaky)).broken == "the valve is open only while filling"


def test_the_lamp_stays_on_for_two_seconds() -> None:
    lamp: Any = program(next(text for text in snippets("st") if "PROGRAM Lamp" in text))
    seen = []
    for ms, button in ((0, False), (10, True), (20, True), (30, False), (2020, False), (2030, False)):
        lamp.button = button
        st_scan(lamp, 2, ms)
        seen.append((lamp.lamp, lamp.presses))
    assert seen == [(False, 0), (True, 1), (True, 1), (True, 1), (True, 1), (False, 1)]
    assert lamp.retained() == {"presses": 1}


def test_the_chart_fills_settles_and_counts_a_batch_once() -> None:
    tank: Any = program(next(text for text in snippets("st") if "INITIAL_STEP" in text))
    seen = []
    scans = (
        (0, True, 0),
        (10, True, 0),
        (20, False, 1),
        (30, False, 2),
        (5040, False, 2),
        (5050, True, 2),
        (5060, True, 0),
    )
    for ms, start, level in scans:  # the condition of a transition sees the T of the present scan
        tank.start, tank.level = start, float(level)
        st_scan(tank, 2, ms)
        seen.append((tank.valve, tank.batches))
    assert seen == [(False, 0), (True, 1), (True, 1), (False, 1), (False, 1), (True, 2), (True, 2)]


def test_every_command_that_the_page_names_exists() -> None:
    named = {
        command for commands in re.findall(r"fieldtwin plc (\w+(?:, \w+)*)", PAGE) for command in commands.split(", ")
    }
    assert {"status", "watch", "why", "force", "pause", "step", "go", "diagram", "prove"} <= named
    assert named <= set(command.commands)
