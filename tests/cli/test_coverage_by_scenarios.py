"""`fieldtwin test` measures the coverage of Structured Text by scenarios, and adds that of unit tests."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner, Result

from fieldtwin.cli.test.test_command import command
from fieldtwin.plc.st.coverage.recording import Recording
from fieldtwin.run.campaigns.ledger import read_entries
from fieldtwin.run.targets.virtual_scenario import run_virtual
from fieldtwin.scenarios.language.form import load_scenario

NEVER = """  ELSIF level > 100.0 THEN
    run := FALSE;
  END_IF
  IF level < -100.0 THEN
    run := FALSE;
  END_IF
"""
OVERFLOW = """TEST 'a level beyond the range stops the pump' VAR fill : Fill; END_VAR
  fill(level := -200.0);
  ASSERT_FALSE(fill.run);
END_TEST
"""
EXAMPLE = Path(__file__).parents[2] / "examples" / "first-bug"


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    shutil.copytree(EXAMPLE, tmp_path / "site")
    monkeypatch.chdir(tmp_path / "site")
    source = Path("fill.st").read_text().replace("  END_IF\n", NEVER)
    Path("fill.st").write_text(source)
    return tmp_path / "site"


def run(*arguments: str) -> Result:
    return CliRunner().invoke(command, arguments, standalone_mode=False)


def statements(path: str = "c.json") -> dict[str, Any]:
    (file,) = json.loads(Path(path).read_text())["files"]
    assert file["path"] == "fill.st"
    found: dict[str, Any] = file["statements"]
    return found


def test_a_scenario_covers_the_statements_that_it_executes(site: Path) -> None:
    done = run("cycle.scenario.yaml", "--coverage", "c.json", "--html", "r.html")
    assert done.return_value == 0, done.output
    found = statements()
    assert (found["executed"], found["of"], [one["line"] for one in found["missed"]]) == (4, 6, [14, 17])
    row = next(line for line in done.output.splitlines() if line.startswith("fill.st"))
    assert row.split() == ["fill.st", "4/6", "4/6", "14,", "17"]
    assert "lines 14, 17" in Path("r.html").read_text()


def test_a_unit_test_adds_the_lines_that_no_scenario_executes(site: Path) -> None:
    Path("fill.test.st").write_text(OVERFLOW)
    done = run(".", "--coverage", "both.json")
    assert done.return_value == 0, done.output
    found = statements("both.json")
    assert (found["executed"], found["of"], [one["line"] for one in found["missed"]]) == (5, 6, [14])


def test_without_a_file_that_shows_it_nothing_is_measured(site: Path) -> None:
    done = run("cycle.scenario.yaml")
    assert done.return_value == 0
    assert "statements" not in done.output


def test_measuring_does_not_change_the_run(site: Path) -> None:
    scenario = load_scenario(Path("cycle.scenario.yaml"), ())
    plain = run_virtual(scenario)
    recording = Recording()
    with recording.active():
        measured = run_virtual(scenario)
    assert measured.trace_hash == plain.trace_hash
    assert any(recording.coverage().values())


@pytest.mark.long
@pytest.mark.timeout(300)
def test_a_campaign_covers_what_its_seeds_execute_also_when_it_continues_with_a_ledger(site: Path) -> None:
    files = ("--coverage", "c.json", "--html", "c.html")
    one = run("cycle.scenario.yaml", "--seeds", "1..1", "--ledger", "l.jsonl", *files)
    assert one.return_value == 0, one.output
    alone = statements()
    assert (alone["executed"], alone["of"], [one["line"] for one in alone["missed"]]) == (4, 6, [14, 17])
    assert "lines 14, 17" in Path("c.html").read_text()
    more = run("cycle.scenario.yaml", "--seeds", "1..2", "--ledger", "l.jsonl")
    assert more.return_value == 0, more.output
    assert "coverage of Structured Text: measured in 1 of 2 runs" in more.output
    entries, _ = read_entries(Path("l.jsonl"))
    assert [(bool(entry.places), bool(entry.executed)) for entry in entries] == [(True, True), (False, False)]
