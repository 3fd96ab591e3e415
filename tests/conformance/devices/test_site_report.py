"""The site acceptance document contains every device, serial number and deviation of the files, escaped."""

from __future__ import annotations

import hashlib
import json
import re
from html import unescape
from pathlib import Path

import pytest
from click.testing import CliRunner, Result
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldtwin.cli.device.diff_command import command as diff
from fieldtwin.cli.recordings.compare_command import command as compare
from fieldtwin.cli.system.report_command import command
from fieldtwin.conformance.core.case import failed, inconclusive, passed, skipped
from fieldtwin.conformance.devices.device_case import DeviceResult, Spoken
from fieldtwin.conformance.devices.modbus.cases import CASES
from fieldtwin.conformance.devices.results import as_json, as_report
from fieldtwin.gateway.core.connection import Direction
from fieldtwin.gateway.core.errors import FileInvalid, UsageError
from fieldtwin.reports.conformance.device import render_html as render_check
from fieldtwin.reports.junit import render_junit
from fieldtwin.reports.site.html import render_html
from fieldtwin.reports.site.reading import read_site
from fieldtwin.reports.site.reading_dump import dump_piece
from fieldtwin.results.subject import Subject

ROOT = Path(__file__).parents[3]
NASTY = "<script>alert('1')</script>"
SUBJECT = Subject(
    "modbus", "tcp://192.0.2.7:502", 17, {"vendor": NASTY, "product code": "FM-3", "serial number": "A1234"},
    "2026-11-21T10:00:00+00:00", 12.5, "A. Fitter", "fieldtwin check modbus tcp://192.0.2.7:502 --unit 17", "write",
    ("holding:100",), 1.0,
)  # fmt: skip
RESULTS = [
    DeviceResult(CASES[0], passed("silence")),
    DeviceResult(CASES[1], failed("answers & <b>wrongly</b>"), spoken=(Spoken(1_500_000, Direction.SENT, "01 03"),)),
    DeviceResult(CASES[2], inconclusive("cannot be told")),
    DeviceResult(CASES[3], skipped("not on this kind of bus")),
    DeviceResult(CASES[4], skipped("it has no function 18")),
    DeviceResult(CASES[5], failed("known"), waived="the meter is replaced in May"),
]


@pytest.fixture
def check(tmp_path: Path) -> Path:
    """Return the JSON of a check, as written by `--out`."""
    path = tmp_path / "unit17.json"
    path.write_text(json.dumps(as_json(SUBJECT, RESULTS)))
    return path


@pytest.fixture
def dump(tmp_path: Path) -> Path:
    """Return a dump of a node with a serial number."""
    lines = [
        {
            "fieldtwin_dump": 1, "protocol": "canopen", "address": 5, "ranges": ["1000h..1FFFh"], "profile": None,
            "endpoint": "can:socketcan/can0", "started": "2026-11-21T11:00:00.000+00:00",
        },
        {"pass": 0, "at": "2026-11-21T11:00:00.000+00:00"},
        {"read": "1018h:04", "hex": "78563412", "us": 900},
        {"read": "1008h:00", "hex": b"incl".hex(), "us": 900},
        {"latency": {"upload": {"count": 2, "p50_us": 900, "p95_us": 950, "most_us": 1000}}},
        {"ended": "2026-11-21T11:00:09.000+00:00", "requests": 2},
    ]  # fmt: skip
    path = tmp_path / "node5.jsonl"
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))
    return path


def report(*words: str | Path) -> Result:
    return CliRunner().invoke(command, [str(word) for word in words], standalone_mode=False)


def words_of(html: str) -> str:
    """Return the visible text."""
    body = html[html.index("<body") :]
    return " ".join(unescape(re.sub(r"<[^>]*>", " ", body)).split())


def test_the_document_contains_everything_in_the_files(check: Path, dump: Path, tmp_path: Path) -> None:
    out = tmp_path / "site.html"
    result = report(
        check, dump, "-o", out, "--site", "Pump house 3", "--by", "A. Fitter", "--for", "Water board", "--label",
        "unit 17=Flow meter F3", "--remarks", "1 < 2",
    )  # fmt: skip
    assert result.return_value == 0, result.output
    assert "2 devices, 1 deviation, 1 open point" in result.output
    page = out.read_text()
    seen = words_of(page)
    for said in (
        "Pump house 3", "Water board", "A. Fitter", "Flow meter F3", "unit 17", "node 5", "A1234", "305419896", "incl", "FM-3",
        "1 deviation, 1 open point, 1 waived", "answers & <b>wrongly</b>", "cannot be told", "the meter is replaced in May",
        CASES[1].clause, CASES[1].id, CASES[1].must, "it has no function 18", "2026-11-21 10:00 UTC", NASTY, "1 < 2",
        hashlib.sha256(check.read_bytes()).hexdigest(), hashlib.sha256(dump.read_bytes()).hexdigest(), "Signatures",
    ):  # fmt: skip
        assert said in seen, said
    assert "<script" not in page
    assert "http" not in page.replace("https://", "")
    assert "not on this kind of bus" not in seen


def test_comparisons_and_differences_as_the_commands_write_them(tmp_path: Path) -> None:
    recorded = (ROOT / "recordings" / "aqualabo-c4e.jsonl").read_text().splitlines(keepends=True)[:40]
    one, other = tmp_path / "one.jsonl", tmp_path / "other.jsonl"
    one.write_text("".join(recorded))
    recorded[2] = recorded[2].replace("41636cc1", "41636cc2")
    other.write_text("".join(recorded))
    compared = CliRunner().invoke(compare, [str(one), str(other), "--json"], standalone_mode=False)
    assert compared.return_value == 1, compared.output
    dumps = []
    for name, value in (("before", "0001"), ("after", "0002")):
        lines = [
            {
                "fieldtwin_dump": 1, "protocol": "modbus", "address": 30, "ranges": ["holding:5..5"], "profile": None,
                "endpoint": "tcp://192.0.2.9:502", "started": "2026-11-21T11:00:00.000+00:00",
            },
            {"pass": 0, "at": "2026-11-21T11:00:00.000+00:00"},
            {"read": "holding:5", "hex": value, "us": 900},
            {"function": 0x2B, "hex": "0e0183000001" + "0004" + b"ACME".hex(), "us": 900},
            {"ended": "2026-11-21T11:00:09.000+00:00", "requests": 1},
        ]  # fmt: skip
        dumps.append(tmp_path / f"{name}.jsonl")
        dumps[-1].write_text("".join(json.dumps(line) + "\n" for line in lines))
    differs = CliRunner().invoke(diff, [*map(str, dumps), "--json"], standalone_mode=False)
    assert differs.return_value == 1, differs.output
    (tmp_path / "compare.json").write_text(compared.stdout)
    (tmp_path / "diff.json").write_text(differs.stdout)
    out = tmp_path / "site.html"
    result = report(tmp_path / "compare.json", tmp_path / "diff.json", dumps[0], "-o", out)
    assert result.return_value == 0, result.exception
    assert "2 devices, 2 deviations" in result.output or "2 devices, 3 deviations" in result.output
    seen = words_of(out.read_text())
    for said in (
        "unit 30",
        "other.jsonl",
        "one.jsonl",
        "tcp://192.0.2.9:502",
        "after.jsonl",
        "not met",
        "different",
        "Comparison",
    ):
        assert said in seen, said


def test_serial_numbers_from_name_plates_go_before(check: Path, dump: Path, tmp_path: Path) -> None:
    out = tmp_path / "site.html"
    result = report(check, dump, "-o", out, "--serial", "unit 17=Z9", "--json")
    data = json.loads(result.output)
    assert {d["device"]: d["serial_number"] for d in data["devices"]} == {
        "unit 17": "Z9",
        "node 5": "305419896 (12345678h)",
    }
    assert [(d["weight"], d["where"]) for d in data["deviations"]] == [
        ("deviation", CASES[1].id), ("open", CASES[2].id), ("waived", CASES[5].id),
    ]  # fmt: skip
    assert isinstance(report(check, "-o", out, "--serial", "unit 3=Z9").exception, UsageError)


def test_a_folder_is_searched_and_unrelated_files_are_omitted(check: Path, dump: Path, tmp_path: Path) -> None:
    (tmp_path / "other.json").write_text("{}")
    (tmp_path / "node5.sent.jsonl").write_text('{"started": "x"}\n')
    result = report(tmp_path, "-o", tmp_path / "site.html")
    assert result.return_value == 0
    assert tmp_path.name in (tmp_path / "site.html").read_text()
    assert result.stderr.count("left out") == 2


def test_a_dump_that_was_broken_off_is_an_open_point(dump: Path, tmp_path: Path) -> None:
    dump.write_text("".join(dump.read_text().splitlines(keepends=True)[:-1]))
    result = report(dump, "-o", tmp_path / "site.html")
    assert "no deviation, 1 open point" in result.output


def test_a_dump_that_left_out_addresses_between_others_is_called_sampled(tmp_path: Path) -> None:
    """Defect: the report said "whole" for a dump that had not requested 29 of 101 addresses."""
    lines = [
        {
            "fieldtwin_dump": 2, "protocol": "modbus", "address": 1, "ranges": ["holding:0..9"], "profile": None,
            "endpoint": "tcp://192.0.2.9:502", "started": "2026-11-21T11:00:00.000+00:00",
        },
        {"pass": 0, "at": "2026-11-21T11:00:00.000+00:00"},
        {"read": "holding:0..9", "code": 2, "us": 900},
        {"read": "holding:0..3", "hex": "0001000200030004", "us": 900},
        {"read": "holding:8", "code": 2, "us": 900},
        {"read": "holding:9", "code": 2, "us": 900},
        {"ended": "2026-11-21T11:00:09.000+00:00", "requests": 4},
    ]  # fmt: skip
    path = tmp_path / "sampled.jsonl"
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))
    piece = dump_piece(path)
    assert piece.verdict == "sampled"
    assert ("not asked", "4 of 10 addresses; their neighbours were") in piece.facts


@pytest.mark.parametrize(
    "text",
    [
        "",
        "{",
        "[]",
        '{"kind": "fieldtwin check"}',
        '{"kind": "fieldtwin check", "about": {}, "cases": [1], "counts": 2}',
    ],
)
def test_a_file_of_a_different_kind_is_refused(text: str, tmp_path: Path) -> None:
    path = tmp_path / "x.json"
    path.write_text(text)
    assert isinstance(report(path, "-o", tmp_path / "site.html").exception, FileInvalid)
    assert not (tmp_path / "site.html").exists()


def test_a_damaged_file_of_a_folder_is_reported(check: Path, dump: Path, tmp_path: Path) -> None:
    dump.write_text(dump.read_text().replace("1018h:04", "1018h:zz"))
    assert isinstance(report(tmp_path, "-o", tmp_path / "site.html").exception, FileInvalid)


def test_an_empty_input_gives_no_document(tmp_path: Path) -> None:
    assert isinstance(report(tmp_path, "-o", tmp_path / "site.html").exception, UsageError)


def test_the_report_of_a_check_shows_bytes_and_escapes_text_of_devices() -> None:
    page = render_check(SUBJECT, RESULTS, "fieldtwin check modbus tcp://192.0.2.7:502 --unit 17")
    seen = words_of(page)
    assert "<script" not in page
    for said in (
        NASTY,
        "answers & <b>wrongly</b>",
        "01 03",
        "1.5 ms",
        CASES[1].clause,
        "impact",
        "A. Fitter",
        "failed",
        f"--unit 17 --only {CASES[1].id}",
    ):
        assert said in seen, said
    assert f"For other kinds of bus: {CASES[3].id}." in seen


def test_junit_has_each_case_with_its_bytes() -> None:
    xml = render_junit(as_report(SUBJECT, RESULTS, "again")).decode()
    assert xml.count("<testcase") == len(RESULTS)
    assert xml.count("<failure") == 1
    assert "&gt; 01 03" in xml
    assert f"--only {CASES[1].id}" in xml
    assert f'<property name="case" value="{CASES[1].id}" />' in xml
    assert xml.count('<property name="role" value="device" />') == len(RESULTS)
    assert xml.count(f'<property name="impact" value="{CASES[1].impact.value}" />') >= 1


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=6),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=6), inner, max_size=3),
    max_leaves=6,
)


@given(
    kind=st.sampled_from(["fieldtwin check", "fieldtwin compare", "fieldtwin diff"]),
    keys=st.dictionaries(
        st.sampled_from(
            [
                "about",
                "cases",
                "counts",
                "found",
                "notes",
                "compared",
                "differences",
                "latency",
                "values",
                "met",
                "timing",
            ]
        ),
        JSON,
    ),
)
@settings(max_examples=80, deadline=None)
def test_any_file_gives_a_document_or_a_clear_refusal(
    kind: str, keys: dict[str, object], tmp_path_factory: pytest.TempPathFactory
) -> None:
    path = tmp_path_factory.getbasetemp() / "fuzzed.json"
    about = {
        "protocol": "modbus",
        "endpoint": "tcp://h:1",
        "address": 1,
        "started": "",
        "by": "",
        "command": "",
        "against": "x",
    }
    path.write_text(json.dumps({"about": about} | keys | {"kind": kind}))
    try:
        document, _ = read_site([path], site="x", by="x", prepared="x")
    except FileInvalid:
        return
    render_html(document)
