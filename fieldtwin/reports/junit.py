"""JUnit XML in pytest's dialect (``xunit2`` with properties), as Jenkins and GitLab read it.

A scenario with a seed is a test case; its class is the system and the target. A failure's message is the first check
that failed, and its text contains all failed checks and the command that runs the scenario again. INCONCLUSIVE is an
``error`` with its own type: JUnit has no result that neither passed nor failed, and a build must not take INCONCLUSIVE for
a pass.

`Flavour.JENKINS` writes only what junit-10.xsd allows, the schema by which Jenkins' xUnit plugin accepts or refuses a
file. That schema has no properties of test cases: they become lines at the beginning of ``system-out``.
"""

from __future__ import annotations

from enum import Enum
from pathlib import Path
from xml.etree import ElementTree as ET

from fieldtwin.book import case_url
from fieldtwin.reports.file import put
from fieldtwin.reports.markup import clean
from fieldtwin.results.model import CheckResult, Report, ScenarioResult, Verdict

MOST_TEXT = 20_000
"""Largest number of characters in the text of one test case."""


class Flavour(Enum):
    """The program that reads the JUnit file, because programs expect different forms."""

    COMMON = "common"
    """pytest's dialect: test cases have properties."""
    JENKINS = "jenkins"
    """The file satisfies junit-10.xsd."""


def write_junit(report: Report, path: Path, flavour: Flavour = Flavour.COMMON) -> None:
    """Write the file. Raises `FileInvalid` if that is not possible."""
    put(path, render_junit(report, flavour))


def render_junit(report: Report, flavour: Flavour = Flavour.COMMON) -> bytes:
    """Return the file's content, UTF-8."""
    counts, total = report.counts, sum(s.took_s for s in report.scenarios)
    suites = ET.Element("testsuites", name=clean(report.title))
    suite = ET.SubElement(
        suites, "testsuite", name=clean(report.title), errors=str(counts[Verdict.ERROR] + counts[Verdict.INCONCLUSIVE]),
        failures=str(counts[Verdict.FAILED]), skipped=str(counts[Verdict.SKIPPED]),
        tests=str(len(report.scenarios)), time=f"{total:.3f}",
    )  # fmt: skip
    if report.started:
        suite.set("timestamp", clean(report.started))
    _properties(suite, _facts(report))
    for scenario in report.scenarios:
        _case(suite, report, scenario, flavour)
    ET.indent(suites)
    return b"<?xml version='1.0' encoding='utf-8'?>\n" + ET.tostring(suites, encoding="unicode").encode() + b"\n"


def _facts(report: Report) -> list[tuple[str, str]]:
    facts = [("target", report.target), ("seed", "" if report.seed is None else str(report.seed))]
    for system in report.systems:
        facts += [("system", system.name), ("system hash", system.hash)]
    facts += [("reproduce", report.reproduce), *report.versions.items()]
    return [(name, value) for name, value in facts if value]


def _properties(parent: ET.Element, facts: list[tuple[str, str]]) -> None:
    if facts:
        properties = ET.SubElement(parent, "properties")
        for name, value in facts:
            ET.SubElement(properties, "property", name=clean(name), value=clean(value))


def _case(suite: ET.Element, report: Report, scenario: ScenarioResult, flavour: Flavour) -> None:
    under_test = scenario.system or report.system
    system = under_test.name if under_test is not None else "fieldtwin"
    target = scenario.target or report.target
    case = ET.SubElement(
        suite, "testcase", classname=clean(f"{system}.{target}" if target else system), name=clean(scenario.title),
        time=f"{scenario.took_s:.3f}",
    )  # fmt: skip
    facts = [
        (name, value) for name in ("case", "role", "impact", "basis", "clause") if (value := getattr(scenario, name))
    ]
    if url := case_url(scenario.case):
        facts.append(("page", url))
    if scenario.file:  # this is not written as an attribute, because Jenkins' xUnit plugin skips a file with it
        facts.append(("file", f"{scenario.file}:{scenario.line}" if scenario.line else scenario.file))
    if scenario.earlier:
        facts.append(("attempts", str(scenario.attempts)))
        facts += [("inconclusive attempt", reason) for reason in scenario.earlier]
    facts += [("requirement", id) for id in scenario.requirements]
    facts += [("fault", fault.text) for fault in scenario.faults]
    facts += [("trace hash", scenario.trace_hash)] if scenario.trace_hash else []
    lines = [_line(c) for c in scenario.checks]
    if flavour is Flavour.JENKINS:
        lines = [*(f"{name}: {value}" for name, value in facts), *lines]
    else:
        _properties(case, facts)
    verdict, message = scenario.verdict, clean(_message(scenario))
    if verdict is Verdict.FAILED:
        ET.SubElement(case, "failure", message=message, type="fieldtwin.failed").text = _text(scenario)
    elif verdict in (Verdict.ERROR, Verdict.INCONCLUSIVE):
        said = message or verdict.value
        ET.SubElement(case, "error", message=said, type=f"fieldtwin.{verdict.value}").text = _text(scenario)
    elif verdict is Verdict.SKIPPED:
        said = message or verdict.value
        ET.SubElement(case, "skipped", message=said, type="fieldtwin.skipped").text = _text(scenario)
    if lines:
        ET.SubElement(case, "system-out").text = clean(_bounded("\n".join(lines)))


def _message(scenario: ScenarioResult) -> str:
    """Return the scenario's reason, or the first check with the scenario's verdict."""
    if scenario.reason:
        return scenario.reason
    first = next((c for c in scenario.checks if c.verdict is scenario.verdict), None)
    return _line(first) if first else ""


def _text(scenario: ScenarioResult) -> str:
    lines = [_line(c) for c in scenario.checks if c.verdict is not Verdict.PASSED]
    if scenario.reason:
        lines.insert(0, scenario.reason)
    if scenario.evidence:
        lines += ["", "on the wire:", *scenario.evidence]
    if scenario.reproduce:
        lines += ["", f"reproduce: {scenario.reproduce}"]
    return clean(_bounded("\n".join(lines)))


def _line(check: CheckResult) -> str:
    """Return a check as ``4 failed at 13.300 s: ctd.pressure is good; expected good; got bad (file:31)``."""
    at = f" at {check.t_ns / 1e9:.3f} s" if check.t_ns is not None else ""
    said = f"{check.number} {check.verdict.value}{at}: {check.text}"
    for name, value in (("expected", check.expected), ("got", check.got), ("because", check.reason)):
        said += f"; {name} {value}" if value else ""
    return said + (f" ({check.where})" if check.where else "")


def _bounded(said: str) -> str:
    """Return only the beginning and the end of a long text: the command that runs the scenario again is at the end."""
    if len(said) <= MOST_TEXT:
        return said
    half = MOST_TEXT // 2
    return f"{said[:half]}\n[{len(said) - 2 * half} characters left out]\n{said[-half:]}"
