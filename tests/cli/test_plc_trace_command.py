"""`fieldtwin plc trace` in virtual time and in a running prototype, and its files."""

from __future__ import annotations

import csv
import io
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree

import pytest
from shed_site import write_shed

from fieldtwin.plc.runtime.variable_trace import TraceRow
from fieldtwin.reports.run.scan_trace import trace_page, trace_svg
from fieldtwin.results.scan_trace import ScanTrace, TraceColumn

PROGRAM = """PROGRAM idle
  VAR_INPUT level : REAL; END_VAR
  VAR high : BOOL; n : DINT; delay : TON; END_VAR
  n := n + 1;
  delay(IN := TRUE, PT := T#200ms);
  high := n > 60;
END_PROGRAM
"""


@pytest.fixture
def shed(tmp_path: Path) -> Path:
    write_shed(tmp_path)
    (tmp_path / "idle.st").write_text(PROGRAM)
    return tmp_path


def command(shed: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    line = [sys.executable, "-m", "fieldtwin", "plc", "trace", *arguments]
    return subprocess.run(line, cwd=shed, capture_output=True, text=True, timeout=60, check=False)


def test_a_trigger_in_virtual_time_gives_a_table_around_it(shed: Path) -> None:
    wanted = ("idle.n", "idle.delay.ET", "idle.high", "--when", "high", "--before", "2", "--scans", "3")
    done = command(shed, *wanted, "--system", "shed.yaml", "--for", "5s")
    assert done.returncode == 0, done.stderr
    header, *rows = csv.reader(io.StringIO(done.stdout))
    assert header == ["scan", "time_s", "idle.n", "idle.delay.ET [s]", "idle.high"]
    assert [(row[1], *row[2:]) for row in rows] == [
        ("-0.020000", "59", "0.2", "False"),
        ("-0.010000", "60", "0.2", "False"),
        ("0.000000", "61", "0.2", "True"),
        ("0.010000", "62", "0.2", "True"),
        ("0.020000", "63", "0.2", "True"),
    ]


def test_errors_name_what_is_wrong(shed: Path) -> None:
    for arguments, message in (
        (("idle.m", "--system", "shed.yaml"), "no variable 'idle.m' that can be traced"),
        (("idle.n", "--system", "shed.yaml", "-o", "x.pdf"), "expected .csv, .svg, .html, .json"),
    ):
        done = command(shed, *arguments)
        assert done.returncode == 2
        assert message in done.stderr
        assert "Traceback" not in done.stderr


@pytest.fixture
def running(shed: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, str]]:
    folder = tmp_path_factory.mktemp("r")
    env = {**os.environ, "XDG_RUNTIME_DIR": str(folder), "NO_COLOR": "1"}
    line = [sys.executable, "-m", "fieldtwin", "run", "shed.yaml", "--prototype", "--for", "60s"]
    with subprocess.Popen(
        line, cwd=shed, env=env, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    ) as process:
        assert process.stdout is not None
        for text in process.stdout:
            if text.startswith("t="):
                break
        yield env
        process.terminate()


def test_a_running_prototype_is_traced_in_every_scan(shed: Path, running: dict[str, str]) -> None:
    line = [
        sys.executable,
        "-m",
        "fieldtwin",
        "plc",
        "trace",
        "idle.n",
        "tank.level",
        "--scans",
        "50",
        "--json",
        "-o",
        "t.svg",
    ]
    done = subprocess.run(line, cwd=shed, env=running, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    counts = [row[2] for row in found["rows"]]
    assert len(counts) == 50
    assert counts == list(range(counts[0], counts[0] + 50))  # no scan is missing
    assert {row[3] for row in found["rows"]} == {20}
    assert "t.svg: 50 scans" in done.stderr
    ElementTree.parse(shed / "t.svg")


def test_drawings_and_tables_show_times_in_seconds_and_lost_scans() -> None:
    columns = [TraceColumn("a.t", "TIME", "ns"), TraceColumn("a.<b>", "STRING")]
    trace = ScanTrace(columns, 10, triggered=4)
    for n in (0, 1, 4, 5):
        trace.add(TraceRow(n, n + 1, n * 10_000_000, (n * 500_000_000, "=1+1")))
    assert trace.lost == 2
    assert trace.times_s() == [-0.04, -0.03, 0.0, 0.01]
    assert trace.csv().splitlines()[1] == "1,-0.040000,0.0,'=1+1"
    page = str(trace_page(trace, "Trace of <a>"))
    assert "Trace of &lt;a&gt;" in page
    assert "2 scans were lost" in page
    assert "2.5" in page
    root = ElementTree.fromstring(str(trace_svg(trace, "Trace of <a>")))
    assert [e.attrib["class"] for e in root.iter() if e.attrib.get("class") == "trigger"] == ["trigger"]
    ElementTree.fromstring(str(trace_svg(ScanTrace(columns, 1), "empty")))
