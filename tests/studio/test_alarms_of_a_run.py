"""The alarm list of a run in real time: over Studio's interface, with `fieldtwin alarm`, and in the audit log."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
from studio_rig import VIEW, Studio, studio, until

EXAMPLE = Path(__file__).parents[2] / "examples" / "alarms"
TANK = "/instances/tank"


@pytest.fixture(scope="module")
def tank() -> Iterator[Studio]:
    """A running Studio that has started the prototype of the example."""
    with studio("tank.yaml", folder=EXAMPLE) as running:
        with running.client() as client:
            until(lambda: alarm(client, "level_high").get("quality") == "good", "the level is read")
        yield running


def alarm(client: httpx.Client, name: str) -> dict[str, Any]:
    answer = client.get(f"{TANK}/alarms")
    found: dict[str, Any] = answer.json()[name] if answer.status_code == 200 else {}
    return found


def raised(client: httpx.Client, level: float, name: str) -> dict[str, Any]:
    """Set the level, and return the alarm when it is active."""
    client.put(f"{TANK}/tags/sensor.level/set", json={"value": level}).raise_for_status()
    return until(lambda: (a := alarm(client, name))["state"] == "active_unacknowledged" and a, f"{name} is active")


def fieldtwin(tank: Studio, *words: str) -> subprocess.CompletedProcess[str]:
    environment = os.environ | {"FIELDTWIN_RUN": str(tank.run_root), "COLUMNS": "120"}
    command = [sys.executable, "-m", "fieldtwin", "alarm", *words]
    return subprocess.run(command, env=environment, capture_output=True, text=True, timeout=60, check=False)


def test_an_operator_acknowledges_an_alarm_over_the_interface(tank: Studio) -> None:
    with tank.client() as client:
        seen = raised(client, 85, "level_high")
        assert (seen["quality"], seen["priority"], seen["text"]) == ("good", "medium", "Open the drain")
        answer = client.post(f"{TANK}/alarms/level_high/acknowledge")
        assert (answer.status_code, answer.json()["state"]) == (200, "active_acknowledged")
        assert client.post(f"{TANK}/alarms/level_high/acknowledge").status_code == 400
        client.delete(f"{TANK}/tags/sensor.level/set").raise_for_status()
        until(lambda: alarm(client, "level_high")["state"] == "normal", "the alarm returns to normal")
    entries = [json.loads(line) for line in (tank.run_root / "tank" / "audit.jsonl").read_text().splitlines()]
    [entry] = [e for e in entries if e["action"] == "acknowledge" and e["device"] == "alarm.level_high"]
    assert entry["by"].startswith("studio ")


def test_the_role_view_only_reads_alarms(tank: Studio) -> None:
    with tank.client(VIEW) as client:
        assert client.get(f"{TANK}/alarms").status_code == 200
        for method, path in (("POST", "acknowledge"), ("PUT", "shelving"), ("DELETE", "shelving")):
            assert client.request(method, f"{TANK}/alarms/level_high/{path}", json={"for_s": 5}).status_code == 403


def test_an_alarm_is_shelved_and_returns(tank: Studio) -> None:
    with tank.client() as client:
        path = f"{TANK}/alarms/level_low/shelving"
        assert client.put(path, json={"for_s": 3600}).json()["state"] == "shelved"
        left_s = until(lambda: alarm(client, "level_low")["shelved_for_s"], "the alarm is shelved")
        assert 3500 < left_s <= 3600
        assert client.delete(path).json()["state"] == "normal"
        assert client.put(path, json={"for_s": -1}).status_code == 400
        assert client.put(f"{TANK}/alarms/nothing/shelving", json={"for_s": 1}).status_code == 404


def test_an_operator_uses_the_terminal(tank: Studio) -> None:
    with tank.client() as client:
        raised(client, 99, "level_too_high")
        listed = fieldtwin(tank, "list")
        assert listed.stdout.splitlines()[1].split()[0] == "level_too_high"  # the most important one
        assert "active unacknowledged" in listed.stdout
        done = fieldtwin(tank, "acknowledge", "level_too_high")
        assert (done.returncode, done.stdout) == (0, "level_too_high: active acknowledged\n")
        assert json.loads(fieldtwin(tank, "list", "--json").stdout)["level_too_high"]["state"] == "active_acknowledged"
        again = fieldtwin(tank, "acknowledge", "level_too_high")
        assert (again.returncode, again.stdout) == (2, "")
        assert again.stderr.startswith("fieldtwin: alarm 'level_too_high' has nothing to acknowledge; expected active_")
        assert "did you mean 'level_high'" in fieldtwin(tank, "unshelve", "level_hihg").stderr
        client.delete(f"{TANK}/tags/sensor.level/set").raise_for_status()


def test_updates_over_the_websocket_contain_the_alarms(tank: Studio) -> None:
    with tank.client(VIEW) as client:
        assert client.get(TANK).json()["system"]["alarms"] == [
            "level_high",
            "level_too_high",
            "level_low",
            "level_unknown",
        ]
