"""`fieldtwin test --progress FILE`: lines for a display, which change neither the verdict nor the events of the run."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from shed_site import write_shed

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.results.model import ScenarioResult
from fieldtwin.run.targets.progress import Progress
from fieldtwin.run.targets.scenario_targets import ScenarioTarget, run_scenario
from fieldtwin.scenarios.language.form import load_scenario

SCENARIO = """scenario: the level rises
system: shed.yaml
always: ["tank.level < 100"]
steps:
  - wait: {until: tank.level == 20, within: 5s}
  - set: {tag: tank.level, value: VALUE}
  - expect: {that: tank.level == VALUE, within: 5s}
"""


def ran(folder: Path, value: int, name: str = "progress.jsonl") -> tuple[ScenarioResult, list[dict[str, Any]]]:
    write_shed(folder)
    (folder / "rise.scenario.yaml").write_text(SCENARIO.replace("VALUE", str(value)))
    progress = Progress(folder / name)
    result = run_scenario(load_scenario(folder / "rise.scenario.yaml"), ScenarioTarget(), progress=progress)
    progress.close()
    return result, [json.loads(line) for line in (folder / name).read_text().splitlines()]


def verdicts(lines: list[dict[str, Any]]) -> dict[str, str]:
    return {line["number"]: line["verdict"] for line in lines if line["event"] == "verdict"}


def test_lines_name_the_steps_and_checks_before_the_run_and_their_verdicts_in_order(tmp_path: Path) -> None:
    result, lines = ran(tmp_path, 60)
    assert [(line["event"], line.get("number")) for line in lines if line["event"] != "value"] == [
        ("scenario", None),
        *((event, number) for number in "123" for event in ("step", "verdict")),
        *(("verdict", number) for number in ("always 1",)),
        ("result", None),
    ]
    assert lines[0]["steps"][0]["text"] == "wait: until tank.level == 20, within 5s"
    assert lines[0]["checks"] == [{"number": "always 1", "text": "tank.level < 100"}]
    assert lines[-1]["verdict"] == result.verdict.value == "passed"
    assert verdicts(lines) == {check.number: check.verdict.value for check in result.checks}
    assert [line["value"] for line in lines if line["event"] == "value" and line["name"] == "tank.level"][-1] == 60


def test_a_broken_check_has_its_verdict_and_ends_the_run(tmp_path: Path) -> None:
    result, lines = ran(tmp_path, 150)
    assert verdicts(lines) == {"1": "passed", "2": "passed", "3": "inconclusive", "always 1": "failed"}
    assert lines[-1] == {"event": "result", "verdict": "failed", "reason": result.reason}


def test_progress_changes_neither_the_verdict_nor_the_events_of_the_run(tmp_path: Path) -> None:
    result, _ = ran(tmp_path, 60)
    without = run_scenario(load_scenario(tmp_path / "rise.scenario.yaml"), ScenarioTarget())
    assert (result.verdict, result.trace_hash) == (without.verdict, without.trace_hash)


def test_a_file_that_cannot_be_written_is_refused_before_the_run_and_ends_no_run(tmp_path: Path) -> None:
    with pytest.raises(FileInvalid, match="cannot write the progress"):
        Progress(tmp_path / "missing" / "progress.jsonl")
    result, lines = ran(tmp_path, 60, "full")
    (tmp_path / "full").unlink()
    (tmp_path / "full").symlink_to("/dev/full")
    progress = Progress(tmp_path / "full")
    again = run_scenario(load_scenario(tmp_path / "rise.scenario.yaml"), ScenarioTarget(), progress=progress)
    progress.close()
    assert again.trace_hash == result.trace_hash
    assert lines
