"""Operator actions on a PLC of two tasks with `fieldtwin`: negative values, steps, and a stop.

Defects: `plc force TAG -1` failed as an unknown option, `plc step 20` ran the slow task 12 to 20 times, and the inputs of a
stopped PLC were still shown as good.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner
from drive_station import PROFILE, PROTOTYPE, SYSTEM
from procs import fieldtwin, wait_for

from fieldtwin.cli.main import cli

pytestmark = pytest.mark.long

PROGRAM = """\
PROGRAM pump
VAR_INPUT pressure : REAL; END_VAR
VAR_OUTPUT speed : REAL; go : INT; END_VAR
VAR offset : INT; n, zero : INT := 0; END_VAR
n := n + 1;
speed := LIMIT(MX := 50.0, IN := 20.0 + offset, MN := 0.0);
IF offset = -7 THEN n := n / zero; END_IF;
END_PROGRAM
PROGRAM counting
VAR n : INT; END_VAR
n := n + 1;
END_PROGRAM
"""
TASKS = """\
  tasks:
    fast: {interval_ms: 20}
    slow: {interval_ms: 200, late_ms: 100}
  watchdog: {late_ms: 1000, stop_after: 100, restarts: 0}
"""


def written(folder: Path) -> Path:
    (folder / "drive.yaml").write_text(PROFILE)
    (folder / "station.prototype.yaml").write_text(PROTOTYPE)
    text = SYSTEM.replace("  cycle_ms: 50\n", TASKS).replace(
        'source: "SOURCE"', "source: station.st:pump\n      task: fast"
    )
    path = folder / "station.yaml"
    path.write_text(text + "    counting: {source: station.st:counting, task: slow}\n")
    (folder / "station.st").write_text(PROGRAM)
    return path


def plc(*args: str) -> Any:
    done = CliRunner().invoke(cli, ["plc", *args], standalone_mode=False)
    assert done.exception is None, (done.exception, done.output)
    return json.loads(done.stdout) if "--json" in args else done.output


@contextmanager
def station(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setenv("FIELDTWIN_RUN", str(folder))
    path = written(folder)
    with fieldtwin(folder, "run", str(path), "--prototype", "--commands", "3", "--instance", "p", "--json") as run:
        run.control("p", "plc")
        wait_for(lambda: status()["tags"]["drive.pressure"]["quality"] == "good", 30, "the drive is read")
        wait_for(lambda: status()["tasks"]["slow"]["scans"] > 0, 30, "the slow task runs")
        yield


def status() -> Any:
    return plc("status", "--json")


@pytest.mark.timeout(180)
def test_a_plc_of_two_tasks_is_forced_stepped_and_stopped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with station(tmp_path, monkeypatch):
        assert status()["tasks"]["slow"]["late_ms"] == 100
        plc("force", "pump.offset", "-1", "--yes")
        wait_for(lambda: status()["variables"]["pump.speed"] == 19.0, 20, "forced to -1")
        plc("force", "--yes", "pump.offset", "-0x2")
        wait_for(lambda: status()["variables"]["pump.speed"] == 18.0, 20, "forced to -2")

        plc("pause", "--yes")
        wait_for(lambda: status()["state"] == "paused", 20, "paused")
        before = status()["tasks"]
        told = plc("step", "20")
        after = status()["tasks"]
        assert "fast: 20 scans, slow: 2 scans" in told
        assert {name: after[name]["scans"] - before[name]["scans"] for name in before} == {"fast": 20, "slow": 2}
        plc("go")

        plc("force", "pump.offset", "-7", "--yes")  # the logic divides by zero
        wait_for(lambda: status()["state"] == "stopped", 20, "stopped")
        tag = status()["tags"]["drive.pressure"]
        assert (tag["quality"], tag["reason"]) == ("bad", "not operational")
        assert status()["inputs"]["drive.pressure"]["quality"] == "bad"
