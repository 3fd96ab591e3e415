"""The scenario on the page about scenarios runs, and passes."""

from __future__ import annotations

import re
from pathlib import Path

from fieldtwin.report.model import Verdict
from fieldtwin.running.virtual_scenario import run_virtual
from fieldtwin.scenarios.form import WORDS, load_scenario

PAGE = (Path(__file__).resolve().parents[2] / "docs" / "scenarios.md").read_text()


def test_the_example_passes(tmp_path: Path) -> None:
    (text,) = re.findall(r"```yaml\n(.*?)```", PAGE, re.DOTALL)
    path = tmp_path / "x.scenario.yaml"
    path.write_text(text)
    result = run_virtual(load_scenario(path))
    assert result.verdict is Verdict.PASSED, result.checks[-1]


def test_every_step_is_on_the_page() -> None:
    for word in WORDS:
        assert f"`{word}: " in PAGE, word
