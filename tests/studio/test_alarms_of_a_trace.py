"""The alarms of a virtual run in Studio's interface, at each instant of its trace."""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
from studio_rig import VIEW, studio, until
from trace_rig import folded, lines_of

EXAMPLE = Path(__file__).parents[2] / "examples" / "alarms"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("alarms") / "site"
    shutil.copytree(EXAMPLE, made)
    for name in ("high", "lost"):
        command = [sys.executable, "-m", "fieldtwin", "test", f"{name}.scenario.yaml", "--trace", f"{name}.jsonl"]
        subprocess.run(command, cwd=made, check=True, timeout=60, capture_output=True)
    return made


@pytest.fixture(scope="module")
def client(folder: Path) -> Iterator[httpx.Client]:
    with studio(folder=folder) as running, running.client(VIEW) as client:
        for name in ("high", "lost"):
            until(
                lambda name=name: client.get(f"/traces/{name}.jsonl").json()["behind_bytes"] == 0, "the trace is read"
            )
        yield client


def alarms(client: httpx.Client, trace: str, t_ns: int) -> dict[str, Any]:
    found: dict[str, Any] = client.get(f"/traces/{trace}.jsonl/state", params={"at_ns": t_ns}).json()
    assert found["plc"]["outputs"] == {}
    alarms: dict[str, Any] = found["gateway"]["alarms"]
    return alarms


@pytest.mark.parametrize("trace", ["high", "lost"])
def test_states_and_qualities_of_each_instant_are_those_of_the_trace(
    client: httpx.Client, folder: Path, trace: str
) -> None:
    path = folder / f"{trace}.jsonl"
    instants = sorted({t_ns for t_ns, kind, *_ in lines_of(path) if kind == "alarm"})
    for t_ns in [*instants, *(t_ns - 1 for t_ns in instants if t_ns)]:
        known = folded(path, "alarm", t_ns)
        for name, seen in alarms(client, trace, t_ns).items():
            data = known.get(f"alarm.{name}", {"value": "normal", "quality": "bad"})
            assert (seen["state"], seen["quality"]) == (data["value"], data["quality"]), (name, t_ns)


def test_the_time_in_a_state_begins_with_the_change_of_the_state(client: httpx.Client, folder: Path) -> None:
    path = folder / "high.jsonl"
    raised, acknowledged = (
        next(
            t for t, k, where, d in lines_of(path) if (k, where, d.get("value")) == ("alarm", "alarm.level_high", state)
        )
        for state in ("active_unacknowledged", "active_acknowledged")
    )
    seen = alarms(client, "high", acknowledged - 1)["level_high"]
    assert seen["in_state_s"] == pytest.approx((acknowledged - 1 - raised) / 1e9)
    assert alarms(client, "high", acknowledged)["level_high"]["by"] == "scenario"
    assert alarms(client, "high", raised - 1)["level_high"]["in_state_s"] is None
