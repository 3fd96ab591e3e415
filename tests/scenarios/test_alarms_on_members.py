"""Conditions of alarms about members of function blocks and structures, elements of arrays, and global instances."""

from __future__ import annotations

from pathlib import Path

import pytest

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.gateway.core.image.image import OUTPUTS
from fieldtwin.results.model import ScenarioResult, Verdict
from fieldtwin.results.trace import TraceKind
from fieldtwin.run.targets.virtual_scenario import run_virtual
from fieldtwin.scenarios.language.form import load_scenario
from fieldtwin.twin.plant.names import variable_users
from fieldtwin.twin.plant.physical import alarms_of, image_layout, programs_of
from fieldtwin.twin.site.system import System, load_system

PROGRAM = """TYPE Mode : (idle, run, fault) := idle; Level : STRUCT now : REAL; high : BOOL; END_STRUCT END_TYPE
FUNCTION_BLOCK Counter
VAR_INPUT on : BOOL; END_VAR
VAR n : INT; state : Mode; levels : ARRAY[1..3] OF INT; delay : TON; name : STRING := 'x'; END_VAR
  IF on THEN n := n + 1; END_IF
  delay(IN := n > 5, PT := T#200ms);
  IF n > 10 THEN state := Mode#fault; END_IF
  levels[2] := n;
END_FUNCTION_BLOCK
VAR_GLOBAL shared : Counter; END_VAR
PROGRAM Main
VAR c : Counter; more : ARRAY[1..2] OF Counter; map : ARRAY[0..1, 1..2] OF INT; level : Level; mode : Mode; scans : INT; END_VAR
  scans := scans + 1;
  c(on := TRUE); more[2](on := scans > 10); shared(on := scans > 20);
  level.now := INT_TO_REAL(scans); level.high := level.now > 40.0; map[1, 2] := scans;
  IF scans > 50 THEN mode := Mode#run; END_IF
END_PROGRAM
"""
ALARMS = {
    "count": 'condition: "control.c.n >= 8", on_delay_ms: 300',
    "state": "condition: \"control.c.state == 'fault' and control.c.state == 2\"",
    "element": 'condition: "control.c.levels[2] >= 9"',
    "map": 'condition: "control.map[1, 2] >= 4"',
    "of_array": "condition: \"control.more[2].delay.Q and quality(control.more[2].n) == 'good'\"",
    "structure": 'condition: "control.level.high"',
    "global": 'condition: "control.shared.n >= 1"',
    "own": "condition: \"control.mode == 'run'\"",
}
RAISED_S = {
    "count": 0.40, "state": 0.13, "element": 0.11, "map": 0.06, "of_array": 0.38, "structure": 0.43, "global": 0.23,
    "own": 0.53,
}  # fmt: skip
"""When each alarm is raised, if scan n is executed at (n - 1) * 10 ms and the gateway sees its values up to 20 ms later."""


def system_of(folder: Path, alarms: dict[str, str], keys: str = "") -> System:
    (folder / "main.st").write_text(PROGRAM)
    section = "".join(f"  {name}: {{{form}}}\n" for name, form in alarms.items())
    (folder / "line.yaml").write_text(
        "fieldtwin: 1\nsystem: line\nplc:\n  cycle_ms: 10\n  programs:\n"
        f"    control: {{source: main.st{keys}}}\n" + (f"alarms:\n{section}" if alarms else "")
    )
    return load_system(str(folder / "line.yaml"))


def outputs_of(system: System) -> list[str]:
    """Return the tags of the PLC's outputs and variables."""
    return [tag.name for region in image_layout(system).regions if region.name == OUTPUTS for tag in region.tags]


def run(folder: Path, steps: str) -> ScenarioResult:
    path = folder / "x.scenario.yaml"
    path.write_text(f"scenario: members\nsystem: line.yaml\nsteps:\n{steps}")
    return run_virtual(load_scenario(path))


@pytest.mark.parametrize("keys", ["", ", machine_code: true"])
def test_alarms_on_members_are_raised_in_time(tmp_path: Path, keys: str) -> None:
    system_of(tmp_path, ALARMS, keys)
    result = run(tmp_path, "  - expect: {tag: alarm.own, value: active_unacknowledged, within: 2s}\n")
    assert result.verdict is Verdict.PASSED, result.checks[-1]
    raised = {
        e.where.removeprefix("alarm."): e.t_ns / 1e9
        for e in result.trace
        if e.kind is TraceKind.ALARM and e.data["value"] == "active_unacknowledged"
    }
    assert raised == {name: pytest.approx(at, abs=0.021) for name, at in RAISED_S.items()}


def test_the_members_in_alarms_are_tags_also_of_scenarios(tmp_path: Path) -> None:
    system = system_of(tmp_path, ALARMS)
    members = {"control.c.n", "control.c.levels[2]", "control.more[2].delay.Q", "control.shared.n"}
    assert members <= set(outputs_of(system))
    steps = '  - wait: {until: "control.c.levels[2] >= 20 and control.c.state == 2", within: 2s}\n'
    result = run(tmp_path, steps + '  - expect: {tag: "control.c.levels[2]", value: 30, tolerance: 10}\n')
    assert result.verdict is Verdict.PASSED, result.checks[-1]


def test_an_online_change_knows_the_alarms_that_use_a_member(tmp_path: Path) -> None:
    users = variable_users(system_of(tmp_path, ALARMS))
    assert users["control.c.levels[2]"] == ["alarm element"]
    assert users["control.more[2].n"] == users["control.more[2].delay.Q"] == ["alarm of_array"]


def test_without_members_in_alarms_a_program_has_no_more_tags(tmp_path: Path) -> None:
    system = system_of(tmp_path, {"own": ALARMS["own"]})
    assert [config.published for config in programs_of(system)] == [()]
    names = outputs_of(system)
    assert names == outputs_of(system_of(tmp_path, {}))


@pytest.mark.parametrize(
    ("condition", "said"),
    [
        ("control.c.m > 3", r"line.yaml:8:\d+: no tag or variable 'control.c.m'.*did you mean 'control.c.n'"),
        ("control.c.N > 3", "no tag or variable 'control.c.N'.*did you mean 'control.c.n'"),
        ("control.c > 3", "'control.c' has members; expected one of them, such as control.c.on, control.c.n"),
        ("control.c.name == 'x'", r"'control.c.name' is of the type STRING\[80\]; expected a BOOL, a number"),
        ("control.c.levels > 1", r"'control.c.levels' is of the type ARRAY\[1..3\] OF INT; expected a BOOL"),
        ("control.c.levels[4] > 1", r"there is no 'control.c.levels\[4\]'; expected an element of control.c.levels"),
        ("control.c.state == 'falt'", "control.c.state is never 'falt'; expected idle, run, fault"),
        ("control.mode == 'rn'", "control.mode is never 'rn'; expected idle, run, fault"),
        ("control.c.n == 'x'", "control.c.n is a number, and 'x' is a text"),
        ("control.c.levels[i] > 1", r"line.yaml:8:\d+: not the index of an array; expected a number"),
    ],
)
def test_a_wrong_member_is_an_error_of_the_system_file(tmp_path: Path, condition: str, said: str) -> None:
    system = system_of(tmp_path, {"count": f'condition: "{condition}"'})
    with pytest.raises(FileInvalid, match=said):
        alarms_of(system)
