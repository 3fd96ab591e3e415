"""``--junit-flavour jenkins`` writes JUnit XML that satisfies junit-10.xsd, the schema of Jenkins' xUnit plugin.

Defect: every file had properties inside its test cases. The schema does not allow them, and the plugin refused the file. The
rules below restate the schema: the attributes, required attributes and children of each element. Children may be in any order.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path
from xml.etree import ElementTree as ET

import pytest
from click.testing import CliRunner

from fieldtwin.cli.main import cli
from fieldtwin.reports.junit import Flavour, render_junit
from fieldtwin.results.model import CheckResult, Report, ScenarioResult, Struck, Verdict

_RESULT = ({"type", "message"}, set[str](), set[str](), True)
_TEXT = (set[str](), set[str](), set[str](), True)
RULES: dict[str, tuple[set[str], set[str], set[str], bool]] = {
    "testsuites": ({"name", "time", "tests", "failures", "errors"}, set(), {"testsuite"}, False),
    "testsuite": (
        {"name", "tests", "failures", "errors", "group", "time", "skipped", "timestamp", "hostname", "id", "package"}
        | {"file", "log", "url"},
        {"name", "tests", "failures", "errors"},
        {"testsuite", "properties", "testcase", "system-out", "system-err"},
        False,
    ),
    "testcase": (
        {"name", "time", "classname", "group"},
        {"name"},
        {"skipped", "error", "failure", "system-out", "system-err"},
        False,
    ),
    "properties": (set(), set(), {"property"}, False),
    "property": ({"name", "value"}, {"name", "value"}, set(), False),
    "failure": _RESULT,
    "error": _RESULT,
    "skipped": _RESULT,
    "system-out": _TEXT,
    "system-err": _TEXT,
}
"""For each element: its permitted attributes, required attributes, permitted children, and whether it may contain text."""
TIME = re.compile(r"(([0-9]{0,3},)*[0-9]{3}|[0-9]{0,3})*(\.[0-9]*)?")


def violations(data: bytes) -> list[str]:
    """Return the violations of the schema in the file; nothing for a valid file."""
    root = ET.fromstring(data)
    found = [] if root.tag in ("testsuites", "testsuite") else [f"root {root.tag}"]
    for element in root.iter():
        if element.tag not in RULES:
            found.append(f"unknown element {element.tag}")
            continue
        may, must, children, text = RULES[element.tag]
        found += [f"{element.tag}: attribute {name} is unknown" for name in set(element.attrib) - may]
        found += [f"{element.tag}: attribute {name} is missing" for name in must - set(element.attrib)]
        found += [f"{element.tag}: child {child.tag}" for child in element if child.tag not in children]
        held = [element.text, *(child.tail for child in element)]
        found += [f"{element.tag}: text"] if not text and any((t or "").strip() for t in held) else []
        if element.tag != "testcase" and not TIME.fullmatch(element.get("time", "")):
            found.append(f"{element.tag}: time {element.get('time')}")
    return found


def _report(verdict: Verdict, took_s: float = 0.5) -> Report:
    check = CheckResult("4", "pressure <good>", verdict, 13_300_000_000, expected="good", got="bad", where="a.yaml:31")
    scenario = ScenarioResult(
        "a & b",
        verdict,
        (check,),
        ("R-1", "R-2"),
        file="a.yaml",
        line=12,
        seed=7,
        took_s=took_s,
        trace_hash="ab",
        earlier=("the host was late",),
        case="C-1",
        role="controller",
        impact="read",
        faults=(Struck("f", "drop", "line1", 3),),
        evidence=("sent 01 03",),
        reproduce="fieldtwin test a.yaml",
    )
    return Report("nightly", [scenario], target="virtual", seed=7, started="2026-11-21T12:00:00")


@pytest.mark.parametrize("verdict", Verdict)
@pytest.mark.parametrize("took_s", [0.0, 0.5, 12_345.678])
def test_every_verdict_satisfies_the_jenkins_schema(verdict: Verdict, took_s: float) -> None:
    assert violations(render_junit(_report(verdict, took_s), Flavour.JENKINS)) == []


def test_the_common_flavour_has_properties_that_the_jenkins_schema_forbids() -> None:
    assert violations(render_junit(_report(Verdict.FAILED))) == ["testcase: child properties"]


def test_properties_defined_elsewhere_are_kept_in_the_output() -> None:
    common = ET.fromstring(render_junit(_report(Verdict.FAILED)))
    jenkins = ET.fromstring(render_junit(_report(Verdict.FAILED), Flavour.JENKINS))
    lines = (jenkins.findtext(".//testcase/system-out") or "").splitlines()
    facts = [f"{p.get('name')}: {p.get('value')}" for p in common.iterfind(".//testcase/properties/property")]
    assert len(facts) > 5
    assert lines[: len(facts)] == facts
    assert lines[len(facts)].startswith("4 failed")


def test_a_report_without_scenarios_satisfies_the_jenkins_schema() -> None:
    assert violations(render_junit(Report("empty", []), Flavour.JENKINS)) == []


SCENARIO = """scenario: a level <that> is wrong
system: observatory
requirements: [R-1]
steps:
  - expect: {that: "quality(ctd.pressure) == 'good' and ctd.pressure < -1", within: 5s}
"""


def test_fieldtwin_test_writes_the_flavour_that_was_asked_for(tmp_path: Path) -> None:
    scenario, out = tmp_path / "x.scenario.yaml", tmp_path / "out.xml"
    scenario.write_text(SCENARIO)
    done = CliRunner().invoke(cli, ["test", str(scenario), "--junit", str(out), "--junit-flavour", "jenkins"])
    assert out.exists(), done.output
    assert violations(out.read_bytes()) == []
    assert ET.fromstring(out.read_bytes()).find(".//testcase/failure") is not None


MASTER = """
import os, socket
link = socket.create_connection((os.environ["FIELDTWIN_HOST"], int(os.environ["FIELDTWIN_PORT"])))
number = 0
while True:
    number = (number + 1) % 65536
    link.sendall(number.to_bytes(2, "big") + bytes((0, 0, 0, 6, 1, 3, 0, 0, 0, 1)))
    link.recv(100)
"""
"""A careless client: it sends the next request after every reply, whatever the reply is."""


def test_a_check_of_a_client_writes_the_flavour_that_was_asked_for(tmp_path: Path) -> None:
    out = tmp_path / "out.xml"
    words = ["check", "modbus-client", "--listen", "tcp://127.0.0.1:0", "--only", "MB-013", "--patience", "1s"]
    done = CliRunner().invoke(
        cli, [*words, "--junit", str(out), "--junit-flavour", "jenkins", "--", sys.executable, "-c", MASTER]
    )
    assert out.exists(), done.output
    assert violations(out.read_bytes()) == []
    assert ET.fromstring(out.read_bytes()).find(".//testcase") is not None
