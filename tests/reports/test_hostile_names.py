"""Names and texts from files are escaped in each kind of output file: markup, control characters and formulas.

Defect: a signal named `=HYPERLINK(...)` was a formula in an exported table, which a spreadsheet executes when a user opens it.
"""

from __future__ import annotations

import csv
import xml.etree.ElementTree as ET
from html.parser import HTMLParser
from pathlib import Path

import pytest

from fieldtwin.capture.recordings.exporting import export
from fieldtwin.gateway.core.files.recording import RecordingHeader, RecordingWriter, SignalInfo
from fieldtwin.reports.junit import render_junit
from fieldtwin.reports.run.html import render_html
from fieldtwin.results.model import Report, ScenarioResult, Verdict
from fieldtwin.service.exposition import Family, render

FORMULAS = ("=1+1", "+1+1", "-1+1", "@SUM(A1)", "\t=1+1", "\r=1+1", '=HYPERLINK("http://x","y")')
NAMES = (*FORMULAS, "<script>alert(1)</script>", "\x1b[31mred", "a\x00b", "line\nbreak", '" onload="x')


def test_an_exported_table_has_no_cell_that_is_a_formula(tmp_path: Path) -> None:
    signals = {name: SignalInfo(unit="", column=name) for name in FORMULAS}
    header = RecordingHeader(version=1, device="x", kind="signals", source="imported", made_by="", signals=signals)
    with RecordingWriter(tmp_path / "r.jsonl", header) as writer:
        writer.row(0.0, [-1.5] * len(FORMULAS))
    export(tmp_path / "r.jsonl", tmp_path / "r.csv")
    with (tmp_path / "r.csv").open(newline="") as file:
        names, values = csv.reader(file)
    assert [name for name in names if name.startswith("'")] == [f"'{name}" for name in FORMULAS]
    assert not [name for name in names if name[0] in "=+-@\t\r"]
    assert values[1:] == ["-1.5"] * len(FORMULAS)  # a number remains a number


class _Tags(HTMLParser):
    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: set[str] = set()
        self.attributes: set[str] = set()
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.add(tag)
        self.attributes.update(name for name, _ in attrs)


@pytest.mark.parametrize("name", NAMES)
def test_a_name_is_text_in_a_page_in_junit_and_in_metrics(name: str) -> None:
    report = Report(name, [ScenarioResult(name, Verdict.FAILED, reason=name, reproduce=name)])
    plain = Report("x", [ScenarioResult("x", Verdict.FAILED, reason="x", reproduce="x")])
    html, usual = _Tags(render_html(report)), _Tags(render_html(plain))
    assert (html.tags, html.attributes) == (usual.tags, usual.attributes)
    junit = ET.fromstring(render_junit(report))
    assert [e.tag for e in junit.iter()] == [e.tag for e in ET.fromstring(render_junit(plain)).iter()]
    family = Family("x", "gauge", name)
    family.add(1.0, device=name)
    assert len(render([family]).rstrip("\n").split("\n")) == 3  # help, type and one sample: no injected line
