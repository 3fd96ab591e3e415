"""Results of clients distinguish requirements of the standard, robustness, and known field problems, as those of
devices do.

Defect: every failure of a client was red and gave exit code 1, although many cases require more than any clause. A TCP
client that does not compare the unit ID of a reply conforms (TG 4.4.1.3), and still failed the check.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import pytest
from clients_in_memory import judge, ours
from test_third_party_clients_judged import environment

from fieldtwin.cli.test.check_view import listed, print_results, style_of, why
from fieldtwin.conformance.clients.canopen.cases import CASES as CANOPEN_CLIENTS
from fieldtwin.conformance.clients.modbus.cases import CASES as MODBUS_CLIENTS
from fieldtwin.conformance.clients.results import as_json, as_report
from fieldtwin.conformance.core.case import OTHER_WIRE, OWN, About, Basis, failed, passed, skipped
from fieldtwin.conformance.core.results import CaseResult, exit_code
from fieldtwin.conformance.devices.canopen import cases as canopen_devices
from fieldtwin.conformance.devices.modbus import cases as modbus_devices
from fieldtwin.reports.conformance.client import render_client_html
from fieldtwin.reports.junit import render_junit

CLIENTS: dict[str, About] = {case.about.id: case.about for case in (*MODBUS_CLIENTS, *CANOPEN_CLIENTS)}
DEVICES: tuple[About, ...] = (*modbus_devices.CASES, *canopen_devices.CASES)
CLAUSE = re.compile(r"^(?:(?:SL|AP|TG) )?\d+(?:\.\d+)*(?:$|[;,])")
"""A source that begins with a clause of a Modbus document or of CiA 301."""
REPORT = re.compile(r"(?:^|; )[\w-]+(?: PR)? #\d+")
"""A source that names a report of a different project."""


@pytest.mark.parametrize("case", [*CLIENTS.values(), *DEVICES], ids=lambda case: f"{case.role}-{case.id}")
def test_every_case_has_a_basis_and_a_source_that_fits_it(case: About) -> None:
    for basis, source in [(case.basis, case.clause), *((e.basis, e.clause) for e in case.elsewhere)]:
        if basis is Basis.STANDARD:
            assert CLAUSE.match(source), source
        elif basis is Basis.FIELD:
            assert REPORT.search(source), source
        else:
            assert CLAUSE.match(source) or REPORT.search(source) or source == OWN, source


@pytest.mark.parametrize(
    ("id", "on_a_line", "on_tcp"),
    [
        (
            "MB-015a",
            (Basis.STANDARD, "SL 2.4.1; libmodbus PR #860"),
            (Basis.ROBUSTNESS, "TG 4.4.1.3; libmodbus PR #860"),
        ),
        ("MB-014", (Basis.ROBUSTNESS, OWN), (Basis.STANDARD, "TG 4.4.1.3")),
        ("MB-021", (Basis.ROBUSTNESS, "AP 7"), (Basis.ROBUSTNESS, "AP 7")),
    ],
)
def test_a_result_has_the_basis_and_the_clause_of_its_wire(
    id: str, on_a_line: tuple[Basis, str], on_tcp: tuple[Basis, str]
) -> None:
    for url, expected in (("rtu:/line?baudrate=19200", on_a_line), ("tcp://127.0.0.1:0", on_tcp)):
        case = judge(ours, url, id)[id].case
        assert (case.basis, case.clause, case.elsewhere) == (*expected, ())


def test_only_a_required_case_of_a_client_is_red_and_gives_exit_code_1() -> None:
    good = CaseResult(CLIENTS["MB-002"], passed())
    robust = CaseResult(CLIENTS["MB-021"], failed("waits out its timeout"))
    field = CaseResult(CLIENTS["MB-008"], failed("the value came only later"))
    deviation = CaseResult(CLIENTS["MB-011"], failed("published 3333"))
    assert exit_code([good, robust, field]) == 0
    assert exit_code([good, robust, field], frozenset({Basis.STANDARD, Basis.ROBUSTNESS})) == 1
    assert exit_code([good, field], frozenset({Basis.STANDARD, Basis.ROBUSTNESS})) == 0
    assert exit_code([good, field], frozenset(Basis)) == 1
    assert exit_code([good, deviation]) == 1
    assert "red" in style_of(deviation)
    assert "red" not in style_of(robust) + style_of(field)
    page = render_client_html([good, robust, field], "client on x", ["check"], "2027-01-01T00:00:00+00:00")
    assert '<span class="pill inconclusive">! robustness</span>' in page
    assert '<span class="pill inconclusive">! field problem</span>' in page
    assert '"pill failed' not in page
    assert "robustness: the standard does not require it" in page
    assert "SL: MODBUS over Serial Line V1.02" in page
    can = render_client_html(
        [CaseResult(CLIENTS["CO-001"], passed())], "client on x", ["check"], "2027-01-01T00:00:00+00:00"
    )
    assert "A number alone is a clause of CiA 301 v4.2.0" in can
    page = render_client_html([good, robust, deviation], "client on x", ["check"], "2027-01-01T00:00:00+00:00")
    assert "required by the standard" in page
    assert page.index("MB-011") < page.index("MB-021"), "deviations come first"
    junit = render_junit(as_report([good, robust, deviation], "x", ["check"], "2027-01-01T00:00:00+00:00"))
    assert b'failures="1"' in junit
    assert b"robustness finding: waits out its timeout" in junit
    assert [case["basis"] for case in as_json({}, [good, robust, field], ["check"])["cases"]] == [
        "standard", "robustness", "field problem",
    ]  # fmt: skip


def test_the_list_of_cases_has_the_basis_on_each_wire() -> None:
    case = listed(CLIENTS["MB-015a"])
    assert case["basis"] == "standard"
    assert case["elsewhere"] == [{"wire": "TCP", "basis": "robustness", "clause": "TG 4.4.1.3; libmodbus PR #860"}]


@pytest.mark.parametrize(
    ("id", "said"),
    [
        ("MB-015b", "required by SL 2.4.1"),
        ("MB-027", "required by SL 2.1"),
        ("CO-016", "required by CiA 301, 7.2.4"),
        ("CO-022", "robustness"),
        ("MB-008", "field problem"),
    ],
)
def test_a_failure_names_the_clause_that_requires_it_or_its_kind(id: str, said: str) -> None:
    assert why(CaseResult(CLIENTS[id], failed("seen"))) == said


def test_the_printed_results_name_clauses_and_omit_cases_for_other_wires(
    capsys: pytest.CaptureFixture[str],
) -> None:
    results = [
        CaseResult(CLIENTS["MB-016"], failed("published 3333")),
        CaseResult(CLIENTS["MB-021"], failed("waits")),
        CaseResult(CLIENTS["MB-070a"], skipped(OTHER_WIRE)),
    ]
    print_results(results)
    printed = capsys.readouterr()
    assert printed.out.splitlines() == [
        "failed        MB-016  read     wrong function code in a reply: published 3333 (required by SL 2.4.1, AP 4.1)",
        "robustness    MB-021  read     exception frame of 5 bytes: waits",
        "1 failed, 1 robustness",
    ]
    assert "1 more test cases are for other kinds of bus" in printed.err
    print_results(results, all_wires=True)
    assert "MB-070a" in capsys.readouterr().out


TAKES_ANY_UNIT = """
import os, socket, time
link = socket.create_connection((os.environ["FIELDTWIN_HOST"], int(os.environ["FIELDTWIN_PORT"])))
link.settimeout(1)
number = 0
while True:
    number = number % 65535 + 1
    link.sendall(number.to_bytes(2, "big") + bytes((0, 0, 0, 6, 1, 3, 0, 0, 0, 1)))
    try:
        while True:
            reply = link.recv(100)
            if reply[:4] == number.to_bytes(2, "big") + bytes(2):  # the unit id, reply[6], is not compared
                break
        print(int.from_bytes(reply[-2:], "big"), flush=True)
    except TimeoutError:
        print("no reply", flush=True)
    time.sleep(0.02)
"""


def _check(folder: Path, fail_on: tuple[str, ...], *more: str) -> subprocess.CompletedProcess[str]:
    (folder / "client.py").write_text(TAKES_ANY_UNIT)
    words = ["check", "modbus-client", "--listen", "tcp://127.0.0.1:0", "--timeout", "1s", "--probe", "output"]
    argv = [sys.executable, "-m", "fieldtwin", *words, "--only", "15a,56a", *fail_on, *more]
    return subprocess.run(
        [*argv, "--", sys.executable, "client.py"],
        capture_output=True, text=True, timeout=120, env=environment(), cwd=folder, check=False,
    )  # fmt: skip


@pytest.mark.long
@pytest.mark.parametrize(
    ("fail_on", "code"),
    [((), 0), (("--fail-on", "standard"), 0), (("--fail-on", "robustness"), 1), (("--fail-on", "field"), 1)],
)
def test_fail_on_decides_whether_a_robustness_failure_of_a_client_gives_exit_code_1(
    tmp_path: Path, fail_on: tuple[str, ...], code: int
) -> None:
    done = _check(tmp_path, fail_on, "--junit", "j.xml", "--html", "r.html", "-o", "r.json")
    assert done.returncode == code, done.stderr
    assert "robustness    MB-015a" in done.stdout
    assert "! MB-015a a reply from an unexpected unit (robustness): published 3333" in done.stderr
    assert ("The exit code does not count them: see --fail-on." in done.stderr) == (code == 0)
    results: dict[str, Any] = {case["id"]: case for case in json.loads((tmp_path / "r.json").read_text())["cases"]}
    assert {id: (case["verdict"], case["basis"]) for id, case in results.items()} == {
        "MB-015a": ("failed", "robustness"), "MB-056a": ("passed", "standard"),
    }  # fmt: skip
    suite = ET.parse(tmp_path / "j.xml").getroot().find("testsuite")
    assert suite is not None
    assert (suite.get("failures"), suite.get("skipped")) == (("1", "0") if code else ("0", "1"))
    case = next(c for c in suite.iter("testcase") if "MB-015a" in c.attrib["name"])
    facts = {p.attrib["name"]: p.attrib["value"] for p in case.iter("property")}
    assert (facts["basis"], facts["clause"]) == ("robustness", "TG 4.4.1.3; libmodbus PR #860")
    page = (tmp_path / "r.html").read_text()
    assert '<span class="pill inconclusive">! robustness</span>' in page
    assert '"pill failed"' not in page
    assert ('"pill failed big"' in page) == bool(code)
