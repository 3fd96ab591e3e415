"""`fieldtwin test --traces FOLDER`: a trace for each scenario, and a report with the command for Studio."""

from __future__ import annotations

from pathlib import Path

import pytest
from click.testing import CliRunner

from fieldtwin.cli.test.test_command import command
from fieldtwin.cli.test.trace_files import trace_files
from fieldtwin.gateway.core.errors import FileInvalid, UsageError
from fieldtwin.results.trace_about import read_about

SCENARIO = """scenario: a value that is never there
system: observatory
seed: 2
steps:
  - expect: {tag: ctd.pressure, quality: good, value: -1000, within: 100ms}
"""


def test_each_scenario_gets_a_trace_and_the_report_says_how_to_open_its_failed_check(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("one", "two"):
        (tmp_path / f"{name}.scenario.yaml").write_text(SCENARIO)
    result = CliRunner().invoke(command, [".", "--traces", "traces", "--html", "report.html"], standalone_mode=False)
    assert result.return_value == 1, result.output
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    for name in ("one", "two"):
        about = read_about(tmp_path / "traces" / f"{name}.jsonl")
        assert about is not None
        [check] = [check for check in about.checks if check.verdict == "failed"]
        assert check.t_ns == 100_000_000
        assert f"fieldtwin studio traces/{name}.jsonl --at 0.1s" in page


def test_scenarios_of_the_same_name_get_different_traces(tmp_path: Path) -> None:
    scenarios = [Path(f"{folder}/a.scenario.yaml") for folder in "xyz"]
    found = trace_files(scenarios, None, tmp_path / "new" / "traces")
    assert [path.name for path in found if path is not None] == ["a.jsonl", "a-2.jsonl", "a-3.jsonl"]
    assert (tmp_path / "new" / "traces").is_dir()


def test_a_file_and_a_folder_for_traces_exclude_each_other(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="exclude each other"):
        trace_files([Path("a.scenario.yaml")], "a.jsonl", tmp_path)
    (tmp_path / "file").write_text("")
    with pytest.raises(FileInvalid, match="cannot make the folder"):
        trace_files([Path("a.scenario.yaml")], None, tmp_path / "file")
