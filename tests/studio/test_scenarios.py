"""Scenarios of Studio: recording one from what clients do, and running the files of a system."""

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

NAME = "/instances/observatory"
SCENARIOS = f"{NAME}/scenarios"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The working directory of Studio."""
    return tmp_path_factory.mktemp("studio")


@pytest.fixture(scope="module")
def running(folder: Path) -> Iterator[Studio]:
    """A Studio whose working directory is `folder`, with the observatory's prototype."""
    with studio("observatory", folder=folder) as server:
        yield server


def quality(server: Studio, tag: str) -> str:
    with server.client(VIEW) as client:
        return str(client.get(f"{NAME}/tags").json()[tag]["quality"])


def fieldtwin_test(file: Path) -> dict[str, Any]:
    """Run ``fieldtwin test FILE --json`` in virtual time and return the result."""
    environment = os.environ | {"FIELDTWIN_RUN": str(file.parent / "run")}
    command = [sys.executable, "-m", "fieldtwin", "test", str(file), "--json"]
    done = subprocess.run(command, capture_output=True, env=environment, cwd=file.parent, timeout=120, check=False)
    assert done.stdout, done.stderr.decode()
    [result] = json.loads(done.stdout)
    return dict(result)


def run_to_the_end(server: Studio, path: str, target: str = "virtual") -> dict[str, Any]:
    with server.client() as client:
        client.post(f"{SCENARIOS}/run", json={"path": path, "target": target}).raise_for_status()
        until(lambda: not client.get(f"{SCENARIOS}/run").json()["run"]["running"], "the scenario ends")
        run: dict[str, Any] = client.get(f"{SCENARIOS}/run").json()["run"]
    return run


def test_a_recorded_silence_becomes_a_scenario_that_passes_with_fieldtwin_test(running: Studio, folder: Path) -> None:
    until(lambda: quality(running, "ctd.status") == "good", "the sensor is read")
    with running.client() as client:
        begun = client.post(f"{SCENARIOS}/recording")
        assert begun.json()["recording"], begun.text
        client.put(f"{NAME}/tags/ctd.sample_count/set", json={"value": 7}).raise_for_status()
        until(lambda: held(running, "ctd.sample_count", 7, 1.0), "the gateway has read the value for a second")
        client.delete(f"{NAME}/tags/ctd.sample_count/set").raise_for_status()
        fault = client.post(f"{NAME}/faults", json={"fault": {"name": "silence", "device": "ctd"}}).json()["id"]
        until(lambda: quality(running, "ctd.status") == "bad", "the status turns bad")
        until(lambda: lasted(running, "ctd.status", "bad", 1.0), "it has been bad for a second")
        client.delete(f"{NAME}/faults/{fault}").raise_for_status()
        until(lambda: lasted(running, "ctd.status", "good", 1.0), "the status is good again for a second")
        seen = client.get(f"{SCENARIOS}/recording").json()
        assert [said for _, said in seen["actions"]] == [
            "set ctd.sample_count to 7",
            "release ctd.sample_count",
            "inject silence, device ctd",
            f"clear {fault}",
        ]
        draft = client.delete(f"{SCENARIOS}/recording").json()["draft"]
        saved = Path(client.post(SCENARIOS, json={"name": "silent"}).json()["path"])
    assert saved.read_text() == draft
    assert saved.parent == folder
    assert "expect: {tag: ctd.sample_count, value: 7, quality: good, within:" in draft
    silent, _, recovered = draft.partition("- clear:")
    assert "quality(ctd.status) == 'bad' and reason(ctd.status) ==" in silent
    assert "expect: {tag: ctd.status, quality: good, within:" in recovered
    result = fieldtwin_test(saved)
    assert result["verdict"] == "passed", (draft, result)
    assert [f["struck"] > 0 for f in result["faults"]] == [True]


def lasted(server: Studio, tag: str, wanted: str, seconds: float) -> bool:
    """Return whether a tag has had a quality for so long."""
    with server.client(VIEW) as client:
        found = client.get(f"{NAME}/tags/{tag}/history").json()
    return bool(found["points"]) and all(
        point[2] == wanted for point in points_since(found["points"], found["now_ns"] - int(seconds * 1e9))
    )


def held(server: Studio, tag: str, value: float, seconds: float) -> bool:
    """Return whether a tag has had a value for so long: a recording samples four times a second."""
    with server.client(VIEW) as client:
        found = client.get(f"{NAME}/tags/{tag}/history").json()
    since = points_since(found["points"], found["now_ns"] - int(seconds * 1e9))
    return bool(since) and all(point[1] == value for point in since)


def points_since(points: list[list[Any]], from_ns: int) -> list[list[Any]]:
    """Return the point that was valid at an instant, and the later ones."""
    before = [point for point in points if point[0] <= from_ns]
    return before[-1:] + points[len(before) :]


def test_the_expectations_of_a_recording_can_fail(running: Studio, folder: Path) -> None:
    """Without its fault, the scenario of the recording fails."""
    recorded = folder / "silent.scenario.yaml"
    if not recorded.exists():
        pytest.skip("the recording failed")
    lines = recorded.read_text().splitlines()
    without = folder / "without.scenario.yaml"
    without.write_text("\n".join(line for line in lines if not line.startswith(("  - fault:", "  - clear:"))))
    try:
        assert fieldtwin_test(without)["verdict"] == "failed"
    finally:
        without.unlink()


def test_a_scenario_of_the_list_runs_and_its_steps_and_checks_are_returned(running: Studio) -> None:
    with running.client(VIEW) as client:
        files = client.get(SCENARIOS).json()["files"]
    [silent] = [f for f in files if f["path"].endswith("ctd-silent.scenario.yaml")]
    assert silent["title"] == "CTD falls silent while ACTIVE"
    assert silent["steps"] == 12
    run = run_to_the_end(running, silent["path"])
    assert run["trouble"] == ""
    assert run["result"]["verdict"] == "passed"
    assert [c["number"] for c in run["result"]["checks"]][:12] == [str(n) for n in range(1, 13)]
    assert "always 1" in [c["number"] for c in run["result"]["checks"]]
    seen = {one["number"]: one["verdict"] for one in run["progress"]["steps"] + run["progress"]["checks"]}
    assert seen == {check["number"]: check["verdict"] for check in run["result"]["checks"]}
    assert {name for name, *_ in run["progress"]["values"]} >= {"ctd.pressure", "relay.state"}
    with running.client(VIEW) as client:
        assert run["report"] is True
        assert silent["title"] in client.get(f"{SCENARIOS}/run/report").text
        trace = client.get(f"/traces/{run['trace']}").json()
        assert (trace["title"], trace["verdict"], trace["report"]) == (silent["title"], "passed", True)


def test_a_scenario_with_an_error_reports_the_place(running: Studio, folder: Path) -> None:
    broken = folder / "broken.scenario.yaml"
    broken.write_text('scenario: "<b>"\nsystem: observatory\nsteps:\n  - clear: nothing\n  - waiit: 3s\n')
    run = run_to_the_end(running, str(broken))
    assert run["result"] is None
    assert "broken.scenario.yaml:5" in run["trouble"]
    assert "Traceback" not in run["trouble"]


def begun_steps(client: httpx.Client) -> list[str]:
    steps = client.get(f"{SCENARIOS}/run").json()["run"]["progress"]["steps"]
    return [step["number"] for step in steps if step["begun_s"] is not None and not step["verdict"]]


def test_one_scenario_runs_at_a_time_and_can_be_stopped(running: Studio, folder: Path) -> None:
    slow = folder / "slow.scenario.yaml"
    slow.write_text(
        "scenario: slow\nsystem: observatory\nsteps:\n  - pause: 300s\n  - expect: {tag: ctd.status, quality: good}\n"
    )
    with running.client() as client:
        run = {"path": str(slow), "target": "local"}
        assert client.post(f"{SCENARIOS}/run", json=run).json()["run"]["running"]
        until(lambda: begun_steps(client) == ["1"], "the progress shows that the first step has begun")
        second = client.post(f"{SCENARIOS}/run", json=run)
        assert second.status_code >= 400
        assert "running already" in second.json()["error"]["message"]
        stopped = client.delete(f"{SCENARIOS}/run").json()["run"]
    assert not stopped["running"]
    assert stopped["trouble"] == "stopped"
    assert stopped["result"] is None


def test_a_client_with_the_role_view_looks_but_does_not_record_or_run(running: Studio) -> None:
    with running.client(VIEW) as client:
        assert client.get(SCENARIOS).status_code == 200
        assert client.get(f"{SCENARIOS}/recording").status_code == 200
        for method, path in (
            ("POST", "/recording"),
            ("DELETE", "/recording"),
            ("POST", "/run"),
            ("DELETE", "/run"),
            ("POST", ""),
        ):
            answer = client.request(method, SCENARIOS + path, json={"path": "x", "name": "x"})
            assert answer.status_code == 403, (method, path)


def test_a_recording_does_not_begin_with_active_faults_or_set_values(running: Studio) -> None:
    with running.client() as client:
        client.put(f"{NAME}/tags/ctd.sample_period_s/set", json={"value": 3}).raise_for_status()
        refused = client.post(f"{SCENARIOS}/recording")
        client.delete(f"{NAME}/tags/ctd.sample_period_s/set").raise_for_status()
    assert refused.status_code == 400
    assert "set ctd.sample_period_s" in refused.json()["error"]["message"]


@pytest.mark.parametrize(
    ("method", "path", "body", "status", "text"),
    [
        ("POST", "/run", {"path": "/etc/passwd"}, 404, "no scenario"),
        ("POST", "/run", {"path": "../x.scenario.yaml"}, 404, "no scenario"),
        ("DELETE", "/recording", None, 400, "is not recorded"),
        ("POST", "", {"name": "../../evil"}, 400, "name"),
    ],
)
def test_bad_requests_for_scenarios_are_refused(
    running: Studio, method: str, path: str, body: dict[str, Any] | None, status: int, text: str
) -> None:
    with running.client() as client:
        if path == "":  # saving needs a draft
            client.post(f"{SCENARIOS}/recording").raise_for_status()
            client.delete(f"{SCENARIOS}/recording").raise_for_status()
        answer = client.request(method, SCENARIOS + path, json=body)
    assert answer.status_code == status, answer.text
    assert text in answer.json()["error"]["message"]
