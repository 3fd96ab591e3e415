"""Histories of program variables: the values after each scan of a running PLC, without a scan that is lost silently."""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
from studio_rig import VIEW, Studio, studio, until

from fieldtwin.studio.live.variable_recorder import MOST_SCANS, VariableHistory

TANK = Path(__file__).parents[2] / "examples" / "first-bug"
PROGRAM = """
TYPE Modes : (IDLE, FILLING); END_TYPE
FUNCTION_BLOCK Pump
METHOD Next : INT VAR_INST count : INT; END_VAR count := count + 1; Next := count; END_METHOD
END_FUNCTION_BLOCK
PROGRAM Fill
VAR_INPUT level : REAL; END_VAR
VAR_OUTPUT run : BOOL; END_VAR
VAR pump : Pump; timer : TON; n : INT; due : TIME := T#1s500ms; modes : ARRAY[1..2] OF Modes; END_VAR
  n := pump.Next();
  timer(IN := TRUE, PT := T#1h);
  IF n MOD 2 = 0 THEN modes[2] := Modes#FILLING; ELSE modes[2] := Modes#IDLE; END_IF
END_PROGRAM
"""
VARIABLES = "/instances/tank/plc/variables"


def tank_folder(folder: Path) -> None:
    shutil.copytree(TANK, folder)
    (folder / "fill.st").write_text(PROGRAM)
    system = folder / "tank.yaml"
    system.write_text(system.read_text().replace("source: fill.st", "source: fill.st\n      dialect: codesys"))


@pytest.fixture(scope="module")
def tank(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Studio]:
    folder = tmp_path_factory.mktemp("variables") / "tank"
    tank_folder(folder)
    with studio("tank.yaml", folder=folder) as running:
        yield running


def history(client: httpx.Client, name: str, **query: int) -> dict[str, Any]:
    found: dict[str, Any] = client.get(f"{VARIABLES}/{name}/history", params=query).raise_for_status().json()
    return found


def test_each_scan_of_a_variable_is_recorded_also_when_another_one_is_added(tank: Studio) -> None:
    with tank.client(VIEW) as client:
        names = until(lambda: client.get(VARIABLES).json(), "the PLC has described its programs")
        assert {"fill.n", "fill.timer.ET", "fill.pump.Next.count", "fill.modes"} <= set(names)
        until(lambda: history(client, "fill.n")["scans"] > 20, "scans are recorded")
        before = history(client, "fill.n")["scans"]
        for name in ("fill.timer.ET", "fill.pump.Next.count", "fill.modes[2]"):  # each begins a new trace in the PLC
            history(client, name)
        until(lambda: history(client, "fill.modes[2]")["scans"] > 20, "the last variable is recorded")
        found = history(client, "fill.n")
        values = [value for _, value, _, _ in found["points"]]
        assert values == list(range(values[0], values[0] + len(values)))
        assert found["scans"] == found["shown"] == len(values) > before
        assert (found["missed"], found["dropped"], found["thinned"]) == (0, 0, False)
        elapsed = history(client, "fill.timer.ET")
        assert (elapsed["type"], elapsed["unit"]) == ("TIME", "ns")
        assert {point[1] for point in history(client, "fill.modes[2]")["points"]} == {"IDLE", "FILLING"}
        few = history(client, "fill.n", points=8)
        assert few["thinned"]
        assert few["shown"] == len(few["points"]) < few["scans"]


def test_an_unknown_variable_is_refused_and_the_others_are_recorded_on(tank: Studio) -> None:
    with tank.client(VIEW) as client:
        until(lambda: history(client, "fill.n")["scans"] > 0, "scans are recorded")
        wrong = client.get(f"{VARIABLES}/fill.tymer.ET/history")
        assert wrong.status_code == 400
        assert "no variable 'fill.tymer.ET' that can be traced" in wrong.json()["error"]["message"]
        assert client.get(f"{VARIABLES}/nothing.n/history").status_code == 404
        before = history(client, "fill.n")["scans"]
        until(lambda: history(client, "fill.n")["scans"] > before, "further scans are recorded")


def test_the_type_of_a_time_is_described(tank: Studio) -> None:
    with tank.client(VIEW) as client:
        programs = until(lambda: client.get("/instances/tank/plc/programs").json(), "the programs are described")
    assert programs["fill"]["variables"]["due"]["type"] == "TIME"


def test_variables_that_a_run_in_virtual_time_has_recorded_are_in_its_trace(tmp_path: Path) -> None:
    folder = tmp_path / "tank"
    tank_folder(folder)
    command = [sys.executable, "-m", "fieldtwin", "simulate", "tank.yaml", "--for", "2s", "--trace", "run.jsonl"]
    unknown = [*command, "--variable", "fill.tymer"]
    wrong = subprocess.run(unknown, cwd=folder, capture_output=True, text=True, timeout=120, check=False)
    assert wrong.returncode == 2
    assert "no variable 'fill.tymer' that can be traced" in wrong.stderr
    names = ["fill.timer.ET", "fill.pump.Next.count", "fill.modes[2]", "fill.n"]
    chosen = [text for name in names for text in ("--variable", name)]
    subprocess.run([*command, *chosen], cwd=folder, check=True, capture_output=True, timeout=120)
    with studio("run.jsonl", folder=folder) as running, running.client(VIEW) as client:
        trace = "/traces/run.jsonl"
        until(lambda: client.get(trace).json()["behind_bytes"] == 0, "the trace is read")
        assert set(names) <= set(client.get(f"{trace}/plc/variables").json())
        found = client.get(f"{trace}/tags/fill.pump.Next.count/history").json()["points"]
        counts = [value for _, value, _, _ in found]
        assert counts == list(range(1, len(counts) + 1))
        assert len(counts) > 150  # a scan every 10 ms
        modes = client.get(f"{trace}/tags/fill.modes[2]/history").json()["points"]
        assert [point[1] for point in modes[:3]] == ["IDLE", "FILLING", "IDLE"]
        about = client.get(f"{trace}/plc/programs").json()["fill"]["variables"]["timer.ET"]
        assert (about["unit"], about["type"], about["role"]) == ("ns", "TIME", "internal")


def test_a_ring_keeps_the_last_scans_and_counts_the_others() -> None:
    made = VariableHistory("p.n", "INT", "")
    for n in range(MOST_SCANS + 5):
        made.add(n * 10, n // 2)
    found = made.between(0, 10**9, points=40)
    assert (made.dropped, found["scans"], found["thinned"]) == (5, MOST_SCANS, True)
    assert found["shown"] == len(found["points"]) <= 44
    assert found["points"][0] == [50, 2, "good", "none"]
    part = made.between(1_001, 1_040)
    assert part["points"] == [[1_000, 50, "good", "none"], [1_020, 51, "good", "none"], [1_040, 52, "good", "none"]]
    assert (part["scans"], part["shown"]) == (4, 4)


def test_missing_scans_are_a_time_without_a_value() -> None:
    made = VariableHistory("p.n", "INT", "")
    made.add(10, 1)
    made.miss(3)
    made.miss()  # of the same gap
    made.add(50, 1)
    made.add(60, None)
    assert made.between(0, 100)["points"] == [
        [10, 1, "good", "none"],
        [11, None, "bad", "not_recorded"],
        [50, 1, "good", "none"],
        [60, None, "bad", "no_value"],
    ]
    assert made.missed == 3
