"""Five bugs, planted one at a time in a copy of the program: `fieldtwin simulate` with faults must end as not ok for each.

Without its bug the same copy, with the same faults and seed, must end as ok. Two of the five were not caught before the oracle
checked values that stay good (`AgeOracle.still_good`) and repeated commands (`MessageOracle`).
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[3]
TREES = ("gateway", "plc", "emulators", "twin", "fieldtwin", "profiles", "recordings")
BUGS = tomllib.loads((ROOT / "tests" / "mutations" / "seeded_bugs.toml").read_text())["mutation"]
CAUGHT_AS = {
    "a late reply is published as good": "ctd.",
    "the check sum is ignored": "published values never occurred in their device",
    "the mailbox sequence is ignored": "arrived twice",
    "a stale value stays good": "inclinometer.slope_",
    "a reply of the wrong unit is accepted": "second.",
}
SECOND_SENSOR = """  second:
    profile: ctd-reference
    bus: line1
    unit: 2
    poll: {values: {every_ms: 500}}
    stale_after_ms: 1500
"""
FAULTS = """faults:
  - {name: corrupt-bits, device: second, direction: reply, bits: 3, every: 3, from: 3s}
  - {name: wrong-unit, device: second, direction: request, unit_id: 1, every: 5, from: 3s}
  - {name: lost-frame, device: inclinometer, cob_id: 0x185, from: 5s, until: 12s}
  - {name: drop, device: modem, direction: reply, every: 9, from: 3s}
"""
LATE = FAULTS + "  - {name: late-reply, device: ctd, function: 4, by_ms: 550, from: 3s, until: 15s}\n"


def add(path: Path, text: str, before: str, target: Path) -> None:
    """Write the file at `path` to `target`, with `text` inserted before the line `before`."""
    found = path.read_text()
    assert found.count(before) == 1
    target.write_text(found.replace(before, text + before))


@pytest.fixture
def files(tmp_path: Path) -> Path:
    """The observatory with a second sensor on its line, whose values differ, and faults for every device."""
    shipped = ROOT / "profiles" / "systems"
    add(shipped / "observatory.yaml", SECOND_SENSOR, "  inclinometer:\n", tmp_path / "observatory.yaml")
    system = tmp_path / "observatory.yaml"
    drifting = system.read_text().replace("{values: {every_ms: 500}, status", "{values: {every_ms: 370}, status")
    system.write_text(drifting)  # so that the sensor measures between a request and its repetition
    played = '  second: {recording: cast.jsonl, speed: 7, at_end: loop, identity: {serial: "0043"}}\n'
    prototype = tmp_path / "observatory.prototype.yaml"
    add(shipped / prototype.name, played, "  inclinometer: {recording", prototype)
    faster = prototype.read_text().replace("speed: 1, at_end: hold", "speed: 20, at_end: loop")
    prototype.write_text(faster)  # so that a late reply has a different value
    (tmp_path / "faults.yaml").write_text(FAULTS)
    (tmp_path / "late.yaml").write_text(LATE)
    return tmp_path


def run(program: Path, files: Path, faults: str = "faults.yaml") -> tuple[int, dict[str, Any]]:
    """Return exit code and summary of the run, with the program in the folder `program`."""
    words = ["--for", "20s", "--seed", "3", "--commands", "1,2,0,-1", "--json"]
    ended = subprocess.run(
        [sys.executable, "-m", "fieldtwin", "simulate", "observatory.yaml", "--faults", faults, *words],
        cwd=files,
        env=os.environ | {"PYTHONPATH": str(program), "PYTHONDONTWRITEBYTECODE": "1"},
        capture_output=True,
        text=True,
        timeout=50,
        check=False,
    )
    assert ended.stdout, ended.stderr
    summary: dict[str, Any] = json.loads(ended.stdout)
    return ended.returncode, summary


def copy_with(bug: dict[str, str], program: Path) -> None:
    """A copy of the program in which `bug` is planted."""
    for tree in TREES:
        shutil.copytree(ROOT / tree, program / tree, symlinks=True, ignore=shutil.ignore_patterns("__pycache__"))
    broken = program / bug["file"]
    text = broken.read_text()
    assert text.count(bug["before"]) == 1
    broken.write_text(text.replace(bug["before"], bug["after"]))


def test_the_run_with_all_faults_is_ok_without_a_bug(files: Path) -> None:
    status, summary = run(ROOT, files)
    assert summary["errors"] == []
    assert status == 0
    assert all(fault["struck"] for fault in summary["faults"]), summary["faults"]


def test_without_a_bug_no_late_reply_is_published_as_good_under_the_other_faults(files: Path) -> None:
    status, summary = run(ROOT, files, "late.yaml")
    assert summary["errors"] == []
    assert status == 0


def _as_test(bug: dict[str, str]):
    """The first bug is caught by each run of the tests, the others with the long ones."""
    return pytest.param(bug, id=bug["case"], marks=[] if bug is BUGS[0] else [pytest.mark.long])


@pytest.mark.parametrize("bug", [_as_test(bug) for bug in BUGS])
def test_the_oracle_catches_the_bug(bug: dict[str, str], files: Path) -> None:
    copy_with(bug, files / "program")
    late = bug["case"] == "a late reply is published as good"
    status, summary = run(files / "program", files, "late.yaml" if late else "faults.yaml")
    assert status == 1
    assert CAUGHT_AS[bug["case"]] in " ".join(summary["errors"]), summary["errors"]
