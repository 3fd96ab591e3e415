"""Waivers and their effect on results."""

from __future__ import annotations

import json
from datetime import date
from pathlib import Path
from xml.etree import ElementTree as ET

import pytest

from fieldtwin.conformance.clients.modbus.cases import CASES
from fieldtwin.conformance.clients.results import as_json, as_report
from fieldtwin.conformance.core.case import Finding, failed, passed, skipped
from fieldtwin.conformance.core.results import CaseResult, exit_code, waive
from fieldtwin.conformance.core.waivers import Waivers, read_waivers
from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.gateway.core.files.yaml_file import parse
from fieldtwin.reports.junit import write_junit
from fieldtwin.results.model import Verdict

KNOWN = {"MB-013", "MB-015", "MB-015a"}
CASE = next(c.about for c in CASES if c.about.id == "MB-015a")
GOOD = """waivers:
  - id: MB-015
    owner: A. Berg
    reason: replaced in May
    expires: 2027-05-31
"""


def _waivers(text: str = GOOD) -> Waivers:
    return read_waivers(parse(text, "w.yaml"), KNOWN)


def _waived(finding: Finding, day: date) -> CaseResult:
    return waive(CaseResult(CASE, finding), _waivers(), day)


def test_a_failure_is_waived_up_to_and_on_the_last_day() -> None:
    result = _waived(failed("published 3333"), date(2027, 5, 31))
    assert result.verdict is Verdict.SKIPPED
    assert result.reason == "waived: replaced in May; owner A. Berg, until 2027-05-31 (failed: published 3333)"
    assert exit_code([result]) == 1, "nothing passed"
    assert exit_code([result, CaseResult(CASE, passed())]) == 0


@pytest.mark.parametrize("finding", [failed("published 3333"), passed(), skipped("no such request")])
def test_an_expired_waiver_is_a_failure_that_states_the_expiry(finding: Finding) -> None:
    result = _waived(finding, date(2027, 6, 1))
    assert result.verdict is Verdict.FAILED
    assert "its waiver expired on 2027-05-31 (replaced in May; owner A. Berg)" in result.reason


def test_a_passing_case_needs_no_waiver() -> None:
    assert _waived(passed(), date(2027, 1, 1)).verdict is Verdict.PASSED


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("MB-015", "MB-51a", "w.yaml:2:5: no case 'MB-51a'; expected MB-015a"),
        ("2027-05-31", "soon", "w.yaml:5"),
        ("    reason: replaced in May\n", "", "w.yaml:2"),
        ("    owner: A. Berg\n", "", "w.yaml:2:5: the key 'owner' is missing"),
        ("A. Berg", "'  '", "w.yaml:3"),
        ("reason", "raeson", "raeson"),
        (
            "    expires: 2027-05-31\n",
            "    expires: 2027-05-31\n  - {id: MB-015, owner: me, reason: again, expires: 2027-05-31}\n",
            "twice",
        ),
    ],
)
def test_a_bad_file_is_reported_with_its_place(old: str, new: str, says: str) -> None:
    with pytest.raises(FileInvalid) as error:
        _waivers(GOOD.replace(old, new))
    assert says in str(error.value)


def test_results_as_json_and_junit(tmp_path: Path) -> None:
    results = [CaseResult(CASE, failed("published 3333"), 1.5), CaseResult(CASE, skipped("no probe"))]
    first, second = as_json({}, results, ["check", "modbus-client"])["cases"]
    assert json.loads(json.dumps(first))["impact"] == "read"
    assert (first["verdict"], second["verdict"]) == ("failed", "skipped")
    write_junit(
        as_report(results, "client", ["check", "modbus-client"], "2027-01-01T00:00:00+00:00"), tmp_path / "j.xml"
    )
    suite = ET.parse(tmp_path / "j.xml").getroot().find("testsuite")
    assert suite is not None
    assert (suite.get("tests"), suite.get("failures"), suite.get("skipped")) == ("2", "1", "1")
    failure = suite.find("testcase/failure")
    assert failure is not None
    assert "published 3333" in failure.get("message", "")
    assert "--only MB-015a" in (failure.text or "")
    about = {p.get("name"): p.get("value") for p in suite.findall("testcase[1]/properties/property")}
    assert about == {
        "case": "MB-015a", "role": "client", "impact": "read", "requirement": "MB-015",
        "basis": "standard", "clause": "SL 2.4.1; libmodbus PR #860",
    }  # fmt: skip
