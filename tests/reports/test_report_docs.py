"""The examples of docs/how-to/reports.md run."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
from report_rig import run_trace

from fieldtwin.results.trace import Trace

PAGE = (Path(__file__).parents[2] / "docs" / "how-to" / "reports.md").read_text(encoding="utf-8")


def test_the_python_of_the_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with open("run.jsonl", "wb") as sink:
        trace = Trace(sink=sink)
        for event in run_trace(3):
            trace.note(*event)
        trace.flush()
    space: dict[str, Any] = {}
    for text in re.findall(r"^```python\n(.*?)^```", PAGE, re.DOTALL | re.MULTILINE):
        exec(compile(text, "docs/how-to/reports.md", "exec"), space)
    assert space["slow"] == []
    assert "<svg" in Path("report.html").read_text(encoding="utf-8")
    assert "the sensor is quick" in Path("report.xml").read_text(encoding="utf-8")


def test_every_option_on_the_page_exists() -> None:
    from fieldtwin.cli.recordings.trace_command import command

    options = {o for p in command.params for o in p.opts}
    used = {
        w for line in PAGE.splitlines() if line.startswith("fieldtwin trace") for w in re.findall(r"--[a-z]+", line)
    }
    assert used
    assert used <= options
