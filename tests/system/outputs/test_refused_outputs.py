"""An output that does not reach its device is an event with tag, value, limit and program line, in every view of a run.

Defect: a program requested `speed := 60.0` with the range 0 to 50; `run` ended ok, `trace --problems` was empty, no scenario
failed, and the drive was started with its old setpoint.
"""

from __future__ import annotations

import json
import signal
from pathlib import Path

import pytest
from click.testing import CliRunner
from drive_station import SYSTEM, TOO_FAST, TOO_FAST_PYTHON, scenario, written
from procs import fieldtwin, no_tracebacks, run_to_end, wait_for

from fieldtwin.cli.recordings.trace_command import command as showing
from fieldtwin.cli.test.test_command import command as judging
from fieldtwin.results.model import Verdict
from fieldtwin.run.targets.virtual_scenario import run_virtual
from fieldtwin.run.virtual.run import VirtualOptions, VirtualRun
from fieldtwin.scenarios.language.form import load_scenario


def summary_of(system: Path, trace: Path | None = None) -> dict[str, object]:
    run = VirtualRun(VirtualOptions(str(system), 3.0, trace=trace))
    run.run()
    return run.summary()


@pytest.mark.parametrize(
    ("program", "place"),
    [(TOO_FAST, "pump, pump.st:5"), (TOO_FAST_PYTHON, "pump, pump_control.py:16")],
    ids=["Structured Text", "Python"],
)
def test_a_run_with_a_refused_output_is_not_ok_and_names_value_limit_and_line(
    tmp_path: Path, program: str, place: str
) -> None:
    summary = summary_of(written(tmp_path, program))
    (error,) = summary["errors"]  # type: ignore[misc]
    assert not summary["ok"]
    assert error.startswith("drive.speed = 60 did not reach the device: ")
    assert "expected 0 to 50 Hz; got 60" in error
    assert error.endswith(f"({place})")


def test_a_value_that_is_not_a_number_is_a_refused_output(tmp_path: Path) -> None:
    nan = TOO_FAST_PYTHON.replace("set_speed(60.0)", 'set_speed(float("nan"))')
    (error,) = summary_of(written(tmp_path, nan, module="nan_control"))["errors"]  # type: ignore[misc]
    assert "drive.speed = nan did not reach the device" in error
    assert "nan_control.py:16" in error


def test_a_value_that_is_requested_for_one_scan_only_is_refused_visibly(tmp_path: Path) -> None:
    """The gateway writes a tag at most ten times a second; a value that is replaced before its turn is never checked."""
    pulse = TOO_FAST.replace("VAR_OUTPUT", "VAR n : INT; END_VAR\nVAR_OUTPUT").replace(
        "  speed := 60.0;\n",
        "  n := n + 1;\n  speed := 10.0 + INT_TO_REAL(n MOD 5);\n  IF n = 20 THEN speed := 60.0; END_IF;\n",
    )
    (error,) = summary_of(written(tmp_path, pulse))["errors"]  # type: ignore[misc]
    assert "drive.speed = 60 did not reach the device" in error
    assert "pump.st:8" in error


def test_problems_of_a_trace_show_a_refused_output(tmp_path: Path) -> None:
    system, trace = written(tmp_path), tmp_path / "run.jsonl"
    summary_of(system, trace)
    shown = CliRunner().invoke(showing, [str(trace), str(system), "--problems"], catch_exceptions=False)
    (line,) = shown.stdout.splitlines()
    assert "refused" in line
    assert "drive.speed = 60" in line
    assert "0 to 50 Hz" in line
    assert "pump.st:5" in line
    as_json = CliRunner().invoke(showing, [str(trace), str(system), "--problems", "--json"])
    told = json.loads(as_json.stdout)
    assert (told["refused"], told["value"], told["cause"], told["place"]) == ("drive.speed", 60.0, "limit", "pump.st:5")


def test_a_scenario_fails_on_a_refused_output_in_text_html_and_junit(tmp_path: Path) -> None:
    written(tmp_path)
    path, html, junit = scenario(tmp_path), tmp_path / "r.html", tmp_path / "r.xml"
    ended = CliRunner().invoke(judging, [str(path), "--html", str(html), "--junit", str(junit)], standalone_mode=False)
    assert ended.return_value == 1
    for text in (ended.output, html.read_text(encoding="utf-8"), junit.read_text(encoding="utf-8")):
        assert "drive.speed = 60 did not reach the device" in text
        assert "0 to 50 Hz" in text
        assert "pump.st:5" in text


def test_a_scenario_that_expects_a_refusal_declares_it(tmp_path: Path) -> None:
    written(tmp_path)
    assert run_virtual(load_scenario(scenario(tmp_path, head="refused: [drive.speed]\n"))).verdict is Verdict.PASSED
    judged = scenario(tmp_path, head="refused: [drive.speed]\njudge: run\n")
    assert run_virtual(load_scenario(judged)).verdict is Verdict.PASSED


def test_a_refusal_that_is_expected_and_does_not_come_fails_the_scenario(tmp_path: Path) -> None:
    written(tmp_path, TOO_FAST.replace("60.0", "40.0"))
    result = run_virtual(load_scenario(scenario(tmp_path, head="refused: [drive.speed]\n")))
    assert result.verdict is Verdict.FAILED
    assert "drive.speed is refused" in result.reason


@pytest.mark.long
def test_a_run_in_processes_reports_the_line_and_its_capture_has_the_refusal(tmp_path: Path) -> None:
    system, capture = written(tmp_path), tmp_path / "capture.jsonl"
    words = ("run", str(system), "--prototype", "--for", "4s", "--instance", "r", "--capture", str(capture))
    ended = run_to_end(tmp_path, *words)
    assert ended.process.returncode == 1, ended.err
    assert "drive.speed = 60 did not reach the device" in ended.out
    assert "pump.st:5" in ended.out
    assert "! drive.speed = 60 did not reach the device" in ended.err  # the live view, while it runs
    shown = CliRunner().invoke(showing, [str(capture), str(system), "--problems"], catch_exceptions=False)
    assert "drive.speed = 60" in shown.stdout
    assert "pump.st:5" in shown.stdout
    no_tracebacks(tmp_path)


@pytest.mark.long
def test_a_scenario_in_processes_fails_on_a_refused_output(tmp_path: Path) -> None:
    written(tmp_path)
    # The refusal ends the scenario, even if it came before the scenario's first observation. The pause is only the limit.
    ended = run_to_end(tmp_path, "test", str(scenario(tmp_path, "  - pause: 30s\n")), "--target", "local")
    assert ended.process.returncode == 1, ended.err
    assert "drive.speed = 60 did not reach the device" in ended.out
    assert "pump.st:5" in ended.out


@pytest.mark.long
def test_a_read_only_plant_lists_its_unwritten_outputs_and_is_ok(tmp_path: Path) -> None:
    with fieldtwin(
        tmp_path, "emulate", str(written(tmp_path)), "--control", "127.0.0.1:0", "--instance", "f", name="field"
    ) as side:
        endpoint = wait_for(lambda: side.control("f", "field")("get")["listening"]["lan"], 10)
        plant = tmp_path / "plant.yaml"
        plant.write_text(SYSTEM.replace("SOURCE", "pump.st").replace("tcp://drive:502", endpoint), encoding="utf-8")
        ended = run_to_end(tmp_path, "run", str(plant), "--plant", "--for", "3s", "--instance", "p")
        side.signal(signal.SIGINT)
        assert side.wait(4) == 0
    assert ended.process.returncode == 0, ended.out + ended.err
    assert "not written    drive.run, drive.speed: not written, the plant is read-only" in ended.out
    refused = [json.loads(line) for line in (tmp_path / "p" / "audit.jsonl").read_text().splitlines()]
    assert {e["tag"] for e in refused if e["action"] == "refuse"} == {"drive.speed", "drive.run"}


@pytest.mark.long
def test_a_refused_force_is_recorded(tmp_path: Path) -> None:
    with fieldtwin(tmp_path, "run", str(written(tmp_path)), "--prototype", "--instance", "f") as run:
        plc = run.control("f", "plc")
        wait_for(lambda: plc("ready")["ready"], 10)
        with pytest.raises(AssertionError, match="cannot be forced"):
            plc("force", tag="drive.speed", value=70.0, by="ada")
        lines = [json.loads(line) for line in (tmp_path / "f" / "audit.jsonl").read_text().splitlines()]
        (entry,) = [e for e in lines if e["by"] == "ada"]
        assert (entry["action"], entry["tag"], entry["new"]) == ("refuse", "drive.speed", 70.0)
        assert "0 to 50" in entry["result"]
        run.signal(signal.SIGINT)
        run.wait(10)
