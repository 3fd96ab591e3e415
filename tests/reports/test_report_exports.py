"""JUnit XML and value change dumps, read back by third-party parsers."""

from __future__ import annotations

import io
from pathlib import Path
from tempfile import TemporaryDirectory
from xml.etree import ElementTree as ET

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from report_rig import MS, note, observatory, run_trace
from vcd.reader import ScalarChange, TokenKind, VectorChange, tokenize

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.reports.junit import render_junit, write_junit
from fieldtwin.reports.run.machines import machines_of
from fieldtwin.reports.run.vcd import write_vcd
from fieldtwin.results.model import CheckResult, Report, ScenarioResult, Verdict
from fieldtwin.results.trace import TraceEvent, TraceKind

FAILED = CheckResult("4", "pressure <good>", Verdict.FAILED, 13_300 * MS, expected="good", got="bad", where="a.yaml:31")
SKIPPED = CheckResult("5", "set a value", Verdict.SKIPPED, reason="target compose cannot set_value")


def result(verdict: Verdict, **changes: object) -> ScenarioResult:
    base: dict[str, object] = {"checks": (FAILED, SKIPPED), "file": "a.yaml", "line": 12, "seed": 7, "took_s": 0.5}
    return ScenarioResult("a & b", verdict, **{**base, **changes})  # type: ignore[arg-type]


def cases(*results: ScenarioResult) -> list[ET.Element]:
    report = Report("nightly", results, observatory(), target="virtual", seed=7, versions={"fieldtwin": "1"})
    return ET.fromstring(render_junit(report)).findall("./testsuite/testcase")


def test_junit_counts_and_properties() -> None:
    report = Report(
        "nightly",
        [result(v) for v in Verdict],
        observatory(),
        "virtual",
        7,
        "2026-11-21T08:00:00",
        "fieldtwin test a.yaml",
    )
    suite = ET.fromstring(render_junit(report)).find("testsuite")
    assert suite is not None
    wanted = {"tests": "5", "failures": "1", "errors": "2", "skipped": "1", "time": "2.500", "name": "nightly"}
    assert wanted.items() <= suite.attrib.items()
    facts = {p.get("name"): p.get("value") for p in suite.findall("./properties/property")}
    assert (facts["target"], facts["seed"], facts["reproduce"]) == ("virtual", "7", "fieldtwin test a.yaml")


def test_junit_describes_a_failure_and_how_to_repeat_it() -> None:
    (case,) = cases(result(Verdict.FAILED, reproduce="fieldtwin test a.yaml --seed 7", requirements=("R-1", "R-2")))
    assert (case.get("name"), case.get("classname")) == ("a & b [seed 7]", "observatory.virtual")
    assert case.get("time") == "0.500"
    assert ("file", "a.yaml:12") in [(p.get("name"), p.get("value")) for p in case.iter("property")]
    failure = case.find("failure")
    assert failure is not None
    assert failure.get("message") == "4 failed at 13.300 s: pressure <good>; expected good; got bad (a.yaml:31)"
    assert failure.text is not None
    assert failure.text.endswith("reproduce: fieldtwin test a.yaml --seed 7")
    assert [p.get("value") for p in case.findall("./properties/property")] == ["a.yaml:12", "R-1", "R-2"]


def test_junit_never_passes_a_missing_verdict() -> None:
    skipped, inconclusive, passed = cases(
        result(Verdict.SKIPPED), result(Verdict.INCONCLUSIVE, reason="late"), result(Verdict.PASSED)
    )
    found = (skipped.find("skipped"), inconclusive.find("error"))
    assert [(e.get("type"), e.get("message")) for e in found if e is not None] == [
        ("fieldtwin.skipped", "5 skipped: set a value; because target compose cannot set_value"),
        ("fieldtwin.inconclusive", "late"),
    ]
    assert [child.tag for child in passed] == ["properties", "system-out"]


@given(st.text(max_size=40))
@settings(max_examples=50)
def test_junit_holds_any_text(name: str) -> None:
    raw = render_junit(Report(name, [ScenarioResult(name, Verdict.FAILED, reason=name, reproduce=name)]))
    assert ET.fromstring(raw).find(".//failure") is not None


def test_a_text_without_end_is_cut_in_the_middle() -> None:
    checks = [CheckResult(str(n), "x" * 100, Verdict.FAILED) for n in range(1000)]
    (case,) = cases(result(Verdict.FAILED, checks=checks, reproduce="this way"))
    text = case.findtext("failure") or ""
    assert len(text) < 21_000
    assert text.endswith("reproduce: this way")


# -- waveforms ------------------------------------------------------------------------------------------------------------


def read_vcd(path: Path) -> dict[str, list[tuple[int, object]]]:
    """Return every variable by scope and name, with its changes; the reader refuses anything outside the standard."""
    scopes: list[str] = []
    names: dict[str, tuple[str, str]] = {}
    changes: dict[str, list[tuple[int, object]]] = {}
    now = -1
    for token in tokenize(io.BytesIO(path.read_bytes())):
        match token.kind:
            case TokenKind.SCOPE:
                scopes.append(token.scope.ident)
            case TokenKind.UPSCOPE:
                scopes.pop()
            case TokenKind.VAR:
                assert token.var.id_code not in names
                name = ".".join([*scopes[1:], token.var.reference])
                assert name not in changes
                names[token.var.id_code], changes[name] = (name, token.var.type_.value), []
            case TokenKind.CHANGE_TIME:
                assert token.time_change >= now
                now = token.time_change
            case TokenKind.CHANGE_SCALAR | TokenKind.CHANGE_VECTOR | TokenKind.CHANGE_REAL:
                change = token.data
                name, kind = names[change.id_code]
                assert isinstance(change, ScalarChange) == (kind == "wire")
                assert isinstance(change, VectorChange) == (kind == "reg")
                changes[name].append((now, change.value))
    return changes


def word(value: object) -> str:
    return value.to_bytes(64).lstrip(b"\0").decode() if isinstance(value, int) else str(value)


def test_a_run_as_waveforms(tmp_path: Path) -> None:
    system, path = observatory(), tmp_path / "run.vcd"
    write_vcd(path, run_trace(20), system, machines_of(system), "a run\nwith $end in its name")
    found = read_vcd(path)
    assert [(t // MS, word(v)) for t, v in found["plc.relay_state"]] == [
        (0, "STANDBY"), (2010, "ACTIVE"), (16_000, "OFF"), (18_000, "STANDBY"),
    ]  # fmt: skip
    assert found["faults.f1_drop"] == [(0, "x"), (12_000 * MS, "1"), (15_000 * MS, "0")]
    assert found["ctd.pressure"][1] == (21 * MS, 12.5)
    assert [(t // MS, v) for t, v in found["ctd.pressure_quality"]] == [(0, "x"), (21, 0), (12_303, 4), (15_021, 0)]
    waits = found["line1.waiting_1"][1:5]
    assert [(t / MS, v) for t, v in waits] == [(3.0, "1"), (20.5, "0"), (403.0, "1"), (413.0, "0")]
    assert word(found["line1.sent"][1][1]).startswith("ctd: read input registers 30001")
    assert word(found["line1.problem"][1][1]) == "ctd no reply"


def test_names_that_waveform_viewers_reject_are_replaced(tmp_path: Path) -> None:
    events = [
        note(0, TraceKind.TAG, "a b.c-d", value=1, quality="good"), note(0, TraceKind.TAG, "a b.c+d", value=2, quality="good"),
        note(1, TraceKind.TAG, "a b.c-d", value="off", quality="bad"),
        note(2, TraceKind.TAG, "ü.x", value=float("nan"), quality="bad"),
        note(3, TraceKind.TAG, "ü.y", value=True, quality="uncertain"), note(4, TraceKind.TAG, "ü.z", value="", quality="good"),
    ]  # fmt: skip
    write_vcd(tmp_path / "a.vcd", events)
    found = read_vcd(tmp_path / "a.vcd")
    assert [word(v) for _, v in found["a_b.c_d"]] == ["1", "off"]
    assert found["a_b.c_d_2"] == [(0, 2.0)]
    assert found["_.x"] == [(0, 0.0)]
    assert found["_.y"] == [(0, "x"), (3 * MS, "1")]


def test_a_text_does_not_meet_the_quality_of_another_tag(tmp_path: Path) -> None:
    """A tag may have the name under which the quality of another one stands."""
    events = [
        note(1, TraceKind.TAG, "a.b", value=1.5, quality="good"),
        note(2, TraceKind.TAG, "a.b_quality", value="fine", quality="bad"),
    ]  # fmt: skip
    write_vcd(tmp_path / "a.vcd", events)
    found = read_vcd(tmp_path / "a.vcd")
    assert found["a.b_quality"] == [(0, "x"), (1 * MS, 0)]
    assert [word(v) for _, v in found["a.b_quality_2"]] == ["x", "fine"]


KINDS = st.sampled_from(list(TraceKind))
VALUES = st.one_of(st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=60))


@given(st.lists(st.tuples(st.integers(0, 10**9), KINDS, st.text(max_size=6), VALUES), max_size=10))
@settings(max_examples=40)
def test_any_events_make_a_file_that_can_be_read(rows: list[tuple[int, TraceKind, str, object]]) -> None:
    events = [
        TraceEvent(t, kind, where, {"value": value, "on": bool(value), "bytes": "00"}) for t, kind, where, value in rows
    ]
    with TemporaryDirectory() as folder:
        write_vcd(Path(folder) / "a.vcd", events, observatory())
        read_vcd(Path(folder) / "a.vcd")


def test_a_place_that_cannot_be_written(tmp_path: Path) -> None:
    with pytest.raises(FileInvalid, match="cannot write"):
        write_vcd(tmp_path / "no" / "a.vcd", [])
    with pytest.raises(FileInvalid, match="cannot write"):
        write_junit(Report("x", []), tmp_path)


def test_junit_satisfies_pytests_own_reader(tmp_path: Path) -> None:
    """The attributes and order that pytest's xunit2 writes: properties first, then the verdict, then the output."""
    (case,) = cases(result(Verdict.FAILED, requirements=("R-1",)))
    assert [child.tag for child in case] == ["properties", "failure", "system-out"]


KNOWN = {
    "testsuites": {"name", "time", "tests", "failures", "errors"},
    "testsuite": {
        "name",
        "tests",
        "failures",
        "errors",
        "skipped",
        "time",
        "timestamp",
        "hostname",
        "id",
        "package",
        "file",
    },
    "testcase": {"name", "classname", "time", "group"},
    "properties": set(),
    "property": {"name", "value"},
    **{key: {"type", "message"} for key in ("failure", "error", "skipped")},
    "system-out": set(),
}
"""Elements and attributes of junit-10.xsd, the schema by which Jenkins' xUnit plugin refuses files. Properties of test cases
are accepted by every other reader and by newer versions of it."""


@pytest.mark.parametrize("verdict", Verdict)
def test_it_contains_only_content_that_its_schema_knows(verdict: Verdict) -> None:
    report = Report(
        "r", [result(verdict, requirements=("R-1",), trace_hash="ab")], seed=3, started="2026-11-21T12:00:00"
    )
    root = ET.fromstring(render_junit(report))
    assert {root.tag, *(child.tag for child in root)} == {"testsuites", "testsuite"}
    for element in root.iter():
        assert set(element.attrib) <= KNOWN[element.tag], element.tag
    for suite in root.iter("testsuite"):
        assert {"name", "tests", "failures", "errors"} <= set(suite.attrib)
