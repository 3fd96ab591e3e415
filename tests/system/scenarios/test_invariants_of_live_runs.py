"""Invariants of the system file are checked in runs of processes on this host, and in scenarios on the target local."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from well_site import write_program, write_site

from fieldtwin.results.model import Verdict
from fieldtwin.run.targets.scenario_targets import ScenarioTarget, run_scenario
from fieldtwin.scenarios.language.form import load_scenario

pytestmark = pytest.mark.long


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    write_site(tmp_path, "plant", "tcp://192.0.2.1:502")
    with tempfile.TemporaryDirectory(prefix="ft-", dir="/tmp") as runtime:
        monkeypatch.setenv("XDG_RUNTIME_DIR", runtime)
        yield tmp_path


def summary(folder: Path) -> dict[str, Any]:
    words = [sys.executable, "-m", "fieldtwin", "run", "plant.yaml", "--prototype", "--for", "6s", "--json"]
    ended = subprocess.run(words, cwd=folder, env=os.environ, capture_output=True, text=True, check=False)
    told: dict[str, Any] = json.loads(ended.stdout)
    assert ended.returncode == (0 if told["ok"] else 1)
    return told


def test_a_live_run_with_a_broken_invariant_is_not_ok(folder: Path) -> None:
    write_program(folder, "10")
    told = summary(folder)
    found = {one["number"]: one for one in told["invariants"]}
    assert found["invariant always 1"]["verdict"] == "passed", found
    assert found["invariant never 1"]["verdict"] == "failed", found
    (error,) = [error for error in told["errors"] if "invariant" in error]
    assert error.startswith("invariant never 1: well.runs and sensor.level == 42: broken at ")
    assert error.endswith("plant.yaml:14)")


def test_a_live_run_whose_invariants_hold_reports_it(folder: Path) -> None:
    write_program(folder, "50")
    told = summary(folder)
    assert [one["verdict"] for one in told["invariants"]] == ["passed", "passed"], told["invariants"]
    assert not [error for error in told["errors"] if "invariant" in error]


@pytest.mark.parametrize(("limit", "verdict"), [("10", Verdict.FAILED), ("50", Verdict.PASSED)])
def test_a_scenario_on_the_target_local_checks_invariants(folder: Path, limit: str, verdict: Verdict) -> None:
    write_program(folder, limit)
    result = run_scenario(load_scenario(folder / "well.scenario.yaml"), ScenarioTarget("local"))
    assert result.verdict is verdict, result.reason
    if verdict is Verdict.FAILED:
        assert result.reason.startswith("invariant never 1: ")
