"""`fieldtwin plc prove` of programs in Structured Text: its output, exit codes, and the scenario of a counterexample."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
from click.testing import CliRunner

from fieldtwin.cli.main import cli
from fieldtwin.gateway.core.errors import FieldtwinError, FileInvalid, UsageError
from fieldtwin.gateway.core.files.yaml_file import parse

ROOT = Path(__file__).parents[2]
VALVE = """PROGRAM Valve
VAR_INPUT open, close : BOOL; level : REAL; END_VAR
VAR_OUTPUT drive : BOOL; END_VAR
  IF close THEN drive := FALSE; ELSIF open THEN drive := TRUE; END_IF
END_PROGRAM
"""


def prove(*args: object) -> tuple[int, str]:
    """Return exit code and stdout of a command. Its errors are raised."""
    words = ["plc", "prove", *map(str, args)]
    done = CliRunner().invoke(cli, words, catch_exceptions=True, standalone_mode=False)
    if isinstance(done.exception, FieldtwinError):
        raise done.exception
    assert done.exception is None, done.exception
    return int(done.return_value), done.stdout


@pytest.fixture
def valve(tmp_path: Path) -> Path:
    path = tmp_path / "valve.st"
    path.write_text(VALVE, encoding="utf-8")
    return path


def test_the_output_says_what_is_proved_and_what_is_violated(valve: Path) -> None:
    code, text = prove(valve, "--invariant", "NOT (drive AND close)", "--invariant", "closed: NOT drive")
    lines = text.splitlines()
    assert code == 1
    assert lines[0] == "Valve: a scan follows the scan before after T#1ms to T#1h"
    assert lines[1] == "  PROVED for all scans: NOT (drive AND close)"
    assert lines[2] == "  VIOLATED after 1 scan: closed (NOT drive)"
    assert lines[3].split() == ["scan", "after", "open", "close", "level"]
    assert lines[4].split() == ["1", "T#1ms", "TRUE", "FALSE", "0.0"]
    assert lines[5] == "    then drive = TRUE"
    assert lines[6] == "  PROVED for all scans: no scan ends with an error"


PUMPS = """PROGRAM Pump
VAR lamp AT %Q* : BOOL; limit : INT := 1; END_VAR
  lamp := limit > 15;
END_PROGRAM
CONFIGURATION Plant
  RESOURCE Res0 ON PLC
    PROGRAM east : Pump; PROGRAM west : Pump;
  END_RESOURCE
  VAR_CONFIG
    Res0.east.lamp AT %QX0.0 : BOOL; Res0.east.limit : INT := 10;
    Res0.west.lamp AT %QX0.1 : BOOL; Res0.west.limit : INT := 20;
  END_VAR
END_CONFIGURATION
"""


def test_each_program_of_a_configuration_is_proved_with_its_own_values(tmp_path: Path) -> None:
    path = tmp_path / "pumps.st"
    path.write_text(PUMPS)
    assert prove(path, "--program", "east", "--invariant", "NOT lamp")[0] == 0
    assert prove(path, "--program", "west", "--invariant", "NOT lamp")[0] == 1
    with pytest.raises(FileInvalid, match="which program of the configuration is meant"):
        prove(path, "--program", "Pump", "--invariant", "NOT lamp")
    path.write_text(PUMPS.replace("%QX0.1", "%QX0.0"))
    with pytest.raises(FileInvalid, match=r"west may change the global variable %QX0\.0"):
        prove(path, "--program", "east", "--invariant", "NOT lamp")


def test_exit_code_0_means_that_all_invariants_are_proved(valve: Path) -> None:
    assert prove(valve, "--invariant", "NOT (drive AND close)")[0] == 0
    code, text = prove(valve, "--invariant", "NOT drive", "--assume", "no command: NOT open")
    assert code == 0
    assert "  assumed: no command (NOT open)" in text.splitlines()


def test_json_has_all_answers(valve: Path) -> None:
    code, text = prove(valve, "--invariant", "closed: NOT drive", "--scan-interval", 10, 20, "--json")
    found = json.loads(text)
    assert (code, found["program"], found["proved"], found["scan_interval_ms"]) == (1, "Valve", False, [10, 20])
    first, last = found["invariants"]
    assert (first["name"], first["expression"], first["verdict"]) == ("closed", "NOT drive", "violated")
    inputs = {"open": True, "close": False, "level": 0.0}
    assert first["way"] == [{"after_ms": 10, "inputs": inputs, "bad": []}]
    assert first["values"] == {"drive": True}
    assert (last["verdict"], last["induction"], last["way"]) == ("proved", 0, [])


def test_bounded_results_name_the_limit(tmp_path: Path) -> None:
    path = tmp_path / "count.st"
    path.write_text("PROGRAM Count VAR n : UINT; END_VAR n := n + 1; END_PROGRAM", encoding="utf-8")
    code, text = prove(path, "--invariant", "n < 1000", "--scans", 5)
    assert code == 1
    limit = "no proof for later ones (the limit of 5 scans was reached)"
    assert f"  BOUNDED, no violation within 5 scans, {limit}: n < 1000" in text.splitlines()


def site(folder: Path, extra: str = "") -> Path:
    """Write the tank of the first tutorial, with `extra` lines at its program, and return its system file."""
    for file in (ROOT / "examples/first-bug").iterdir():
        (folder / file.name).write_text(file.read_text(encoding="utf-8"), encoding="utf-8")
    path = folder / "tank.yaml"
    text = path.read_text(encoding="utf-8")
    assert "      source: fill.st\n" in text
    path.write_text(text.replace("      source: fill.st\n", f"      source: fill.st\n{extra}"), encoding="utf-8")
    return path


def test_an_invariant_about_an_unknown_text_is_open(tmp_path: Path) -> None:
    text = "PROGRAM P\nVAR_INPUT n : INT; END_VAR\nVAR s : STRING; END_VAR\ns := INT_TO_STRING(n);\nEND_PROGRAM"
    (tmp_path / "text.st").write_text(text)
    code, shown = prove(tmp_path / "text.st", "--invariant", "LEN(s) < 9")
    assert code == 1
    assert "  not exact: the length of a STRING may have any result" in shown
    assert "  OPEN, neither proved nor violated (the model has no exact result of the length of a STRING" in shown


def test_the_output_names_what_the_model_of_messages_and_of_the_clock_assumes(tmp_path: Path) -> None:
    text = """PROGRAM P
VAR_INPUT heard : MESSAGES; END_VAR
VAR_OUTPUT n : DINT; END_VAR
VAR at : LTIME; END_VAR
n := MSG_COUNT(heard);
at := SCAN_TIME();
END_PROGRAM"""
    (tmp_path / "mail.st").write_text(text)
    code, shown = prove(tmp_path / "mail.st", "--invariant", "n < 2")
    assert code == 1
    limits = [
        "heard brings at most 16 messages in a scan, with any content",
        "the first scan is at any time of the clock, and SCAN_TIME() stays below 146 years",
    ]
    assert shown.splitlines()[1:3] == [f"  assumed: {limit}" for limit in limits]
    assert "  VIOLATED after 1 scan: n < 2" in shown.splitlines()
    found = json.loads(prove(tmp_path / "mail.st", "--invariant", "n < 17", "--json")[1])
    assert (found["proved"], found["limits"]) == (True, limits)


def test_invariants_and_assumptions_of_a_system_are_proved(tmp_path: Path) -> None:
    extra = (
        "      invariants: {not above 2 m: NOT (run AND level > 2.0)}\n      assumptions: {in the tank: level <= 2.3}\n"
    )
    code, text = prove(site(tmp_path, extra))
    assert code == 0
    assert text.startswith(
        "Fill: a scan follows the scan before after T#10ms to T#1h\n  assumed: in the tank (level <= 2.3)\n"
    )
    assert "  PROVED for all scans: not above 2 m (NOT (run AND level > 2.0))" in text.splitlines()


def test_a_counterexample_is_a_scenario_that_fails(tmp_path: Path) -> None:
    """The scenario of a violated invariant reproduces the violation in the system."""
    path = site(tmp_path)
    out = tmp_path / "found.scenario.yaml"
    assert prove(path, "--invariant", "NOT (run AND level > 1.5)", "-o", out)[0] == 1
    found = parse(out.read_text(encoding="utf-8"), str(out)).data
    assert found["never"] == ["(pump.run and (sensor.level > 1.5))"]
    done = CliRunner().invoke(cli, ["test", str(out), "--json"], standalone_mode=False)
    assert "never 1 was violated" in done.output


def test_a_file_alone_has_no_scenario(valve: Path, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="a file has no scenarios"):
        prove(valve, "-o", tmp_path / "x.yaml")


def without_solver(*args: object) -> subprocess.CompletedProcess[str]:
    """Run the command in a Python without z3."""
    code = (
        "import sys; sys.modules['z3'] = None; sys.argv[0] = 'fieldtwin'; from fieldtwin.cli.main import main; main()"
    )
    words = [sys.executable, "-c", code, "plc", "prove", *map(str, args)]
    return subprocess.run(words, capture_output=True, text=True, check=False, cwd=ROOT)


def test_a_program_in_python_is_proved_without_the_solver() -> None:
    done = without_solver("observatory", "--max-states", 5)
    assert done.stdout.startswith("relay: no violation in 5 states"), done.stderr


def test_without_the_solver_the_error_names_what_to_install(valve: Path) -> None:
    done = without_solver(valve)
    assert done.returncode == 2
    assert "needs the package z3-solver" in done.stderr
    assert "[prove]" in done.stderr
