"""`fieldtwin test` lists the findings about the programs that it tests."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from click.testing import CliRunner

from fieldtwin.cli.test.test_command import command

EXAMPLE = Path(__file__).parents[2] / "examples" / "first-bug"


@pytest.mark.parametrize("waiver", ["", " // fieldtwin: allow ST101: kept for the next version"])
def test_a_finding_is_listed_once_and_the_scenarios_pass(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, waiver: str
) -> None:
    shutil.copytree(EXAMPLE, tmp_path / "site")
    monkeypatch.chdir(tmp_path / "site")
    source = Path("fill.st").read_text().replace("VAR_INPUT", f"VAR spare : INT; END_VAR{waiver}\nVAR_INPUT", 1)
    Path("fill.st").write_text(source)
    shutil.copy("cycle.scenario.yaml", "again.scenario.yaml")
    done = CliRunner().invoke(command, ["."], standalone_mode=False, catch_exceptions=False)
    assert done.return_value == 0
    assert done.stderr.count("ST101 spare is not used") == (0 if waiver else 1)


@pytest.mark.long
@pytest.mark.timeout(300)
def test_the_report_of_a_campaign_lists_findings_and_waivers_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(EXAMPLE, tmp_path / "site")
    monkeypatch.chdir(tmp_path / "site")
    unused = (
        "VAR old : INT; (* fieldtwin: allow ST101: read by the next version *) END_VAR\n\nVAR spare : INT; END_VAR\n"
    )
    Path("fill.st").write_text(Path("fill.st").read_text().replace("VAR_INPUT", f"{unused}VAR_INPUT", 1))
    words = ["cycle.scenario.yaml", "--seeds", "1..1", "--error", "ST101", "--html", "c.html"]
    done = CliRunner().invoke(command, words, standalone_mode=False, catch_exceptions=False)
    assert done.return_value == 1, done.output
    page = Path("c.html").read_text()
    assert [page.count(text) for text in ("ST101 spare is not used", "ST101 old is not used")] == [1, 1]
    assert "read by the next version" in page
    assert '<span class="pill failed big">' in page  # the run passed, and the check of the programs failed
