"""Every test case has a page, the league's data fit the lock file and the cases, and reports link to the pages."""

from __future__ import annotations

import json
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from click.testing import CliRunner
from page_runner import ROOT

sys.path.insert(0, str(ROOT / "docs" / "book"))

import league

from fieldtwin.book import case_page, case_url
from fieldtwin.cli.main import cli
from fieldtwin.conformance.core.case import failed
from fieldtwin.conformance.core.results import CaseResult, as_scenario, case_json
from fieldtwin.explain.cases import LISTS
from fieldtwin.reports.conformance.client import render_client_html
from fieldtwin.reports.junit import render_junit
from fieldtwin.results.model import Report

IDS = sorted({case.id for _, _, cases in LISTS for case in cases})
LOCK = tomllib.loads((ROOT / "scripts/league.toml").read_text("utf-8"))


def test_every_case_has_a_page_with_its_anchor_and_a_row_in_the_index(staged: Path):
    index = (staged / "reference/cases/README.md").read_text("utf-8")
    for command, tested, cases in LISTS:
        for case in cases:
            name, _, anchor = case_page(case.id).partition("#")
            page = (staged / name.replace(".html", ".md")).read_text("utf-8")
            assert page.count(f"({anchor})=") == 1, case.id
            assert f"## {case.id}: {tested}, {case.title}" in page
            assert f"- **Correct:** {case.must or 'go on'}" in page
            assert f"fieldtwin check {command} ... --only {case.id}" in page
            assert (
                f"[{case.id}]({name.rpartition('/')[2].replace('.html', '.md')}#{anchor}) {case.title} | {case.bases}"
                in index
            )


def test_a_failure_of_the_league_is_on_the_page_of_its_case_with_frames(staged: Path):
    failures = [(row, failure) for row in league.rows() for failure in row.failed]
    assert failures
    for row, failure in failures:
        page = (staged / case_page(failure.id).partition("#")[0].replace(".html", ".md")).read_text("utf-8")
        verdict = "fails" if failure.confirmed else "failure, unconfirmed"
        assert f"{row.title}: **{verdict}**" in page
        assert all(frame in page for frame in failure.frames)


def test_a_confirmed_failure_has_what_was_sent_and_observed():
    for row in league.rows():
        assert row.passed, row.name
        for failure in row.failed:
            assert failure.id in IDS
            assert not failure.confirmed or failure.observed, f"{row.name} {failure.id}"


def test_the_leagues_data_have_the_versions_of_the_lock_file():
    entries = {(kind, name): entry for kind in league.KINDS for name, entry in LOCK[kind].items()}
    for row in league.rows():
        stack = LOCK["stacks"][entries[row.kind, row.name]["stack"]]
        assert f"{row.version}" in stack["packages"][0], f"run scripts/league --only {row.name}"
        assert (row.origin, row.wire) == (stack["from"], entries[row.kind, row.name]["wire"])


def test_every_package_of_the_league_has_an_exact_version():
    for stack in LOCK["stacks"].values():
        sign = {"npm": "@", "PyPI": "=="}.get(stack["from"], "=")
        assert all(sign in package for package in stack["packages"])
        assert all("==" in package for package in stack.get("needs", []))


def test_the_league_lists_its_entries_without_installing_them():
    done = subprocess.run([sys.executable, "scripts/league", "--list"], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert len(done.stdout.splitlines()) == sum(len(LOCK[kind]) for kind in league.KINDS)
    unknown = subprocess.run(
        [sys.executable, "scripts/league", "--only", "nothing"], cwd=ROOT, capture_output=True, text=True
    )
    assert unknown.returncode == 2
    assert "no entry 'nothing'; --list shows them" in unknown.stderr


def test_without_a_published_book_no_report_has_a_link(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.delenv("FIELDTWIN_BOOK", raising=False)
    assert case_url("MB-016") == ""
    html, junit, data = reports()
    assert "mb-016.html" not in html + junit
    assert "page" not in data


def test_reports_link_to_the_page_of_a_case_of_the_named_book(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("FIELDTWIN_BOOK", "https://docs.example.org/fieldtwin/")
    url = "https://docs.example.org/fieldtwin/reference/cases/mb-016.html#mb-016"
    html, junit, data = reports()
    assert html.count(f'<a href="{url}">MB-016</a>') == 2
    assert f'<property name="page" value="{url}" />' in junit
    assert data["page"] == url


def reports() -> tuple[str, str, dict[str, object]]:
    """Return a report of one failed case as HTML, as JUnit XML and as JSON."""
    case = next(case for command, _, cases in LISTS for case in cases if case.id == "MB-016")
    result = CaseResult(case, failed("published 3333"))
    scenario = as_scenario(result, "client", "again", frozenset())
    junit = render_junit(Report("client", [scenario])).decode()
    return render_client_html([result], "client", ["check"], "today"), junit, case_json(result, "device")


def test_explain_names_the_page_of_a_case(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.delenv("FIELDTWIN_BOOK", raising=False)
    said = CliRunner().invoke(cli, ["explain", "MB-015a"]).output
    assert "Page: reference/cases/mb-015.html#mb-015a (built by scripts/docs)" in said
    held = json.loads(CliRunner().invoke(cli, ["explain", "MB-015a", "--json"]).output)
    assert re.fullmatch(r"reference/cases/mb-015\.html#mb-015a", held[0]["page"])
    monkeypatch.setenv("FIELDTWIN_BOOK", "https://docs.example.org")
    assert (
        "Page: https://docs.example.org/reference/cases/mb-015.html#mb-015a"
        in CliRunner().invoke(cli, ["explain", "MB-015a"]).output
    )
