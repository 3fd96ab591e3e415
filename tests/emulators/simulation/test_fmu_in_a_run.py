"""FMUs in runs: the same trace each time, two FMUs that are coupled through devices, and failures that end a run."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import pytest
from click.testing import CliRunner
from fmu_rig import build_fmu, in_prototype, needs_gcc, tank_site
from template_rig import own_system

from fieldtwin.cli.main import cli
from fieldtwin.results.model import ScenarioResult, Verdict
from fieldtwin.results.trace import TraceKind
from fieldtwin.run.targets.scenario_targets import ScenarioTarget, run_scenario
from fieldtwin.run.virtual.run import VirtualOptions, VirtualRun
from fieldtwin.scenarios.language.form import load_scenario

pytestmark = needs_gcc


LOST = [
    """wait: {until: "quality(sensor.level) == 'bad'", within: 10s}""",
    """expect: {that: "quality(pump.run) == 'good' and quality(sensor.level) == 'bad'", during: 5s}""",
]
"""Steps of a scenario in which the sensor is lost and the pump is not."""


def scenario(system: Path, target: str, *steps: str) -> ScenarioResult:
    path = system.with_name("test.scenario.yaml")
    lines = ["scenario: a test", f"system: {system.name}", "steps:", *(f"  - {step}" for step in steps)]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return run_scenario(load_scenario(path), ScenarioTarget(target))


def trace_of(system: Path) -> str:
    out = system.with_name("run.trace.jsonl")
    ended = CliRunner().invoke(
        cli, ["simulate", str(system), "--for", "8s", "--seed", "3", "--trace", str(out)], standalone_mode=False
    )
    assert ended.exit_code == 0, (ended.output, ended.exception)
    return hashlib.sha256(out.read_bytes()).hexdigest()


def test_the_same_seed_and_fmu_give_the_same_trace(tmp_path: Path) -> None:
    first, again = trace_of(tank_site(tmp_path / "a")), trace_of(tank_site(tmp_path / "b"))
    assert first == again
    other = tank_site(tmp_path / "c")
    in_prototype(other, "area: 0.8", "area: 0.9")
    assert trace_of(other) != first, "the trace contains the values of the FMU"


def test_the_pump_of_the_plant_fills_the_tank_of_the_fmu(tmp_path: Path) -> None:
    result = scenario(
        tank_site(tmp_path, 3), "virtual", 'wait: {until: "pump.run", within: 30s}',
        'wait: {until: "sensor.level > 1.4", within: 20s}',
    )  # fmt: skip
    assert result.verdict is Verdict.PASSED, result


def test_two_fmus_are_coupled_through_devices(tmp_path: Path) -> None:
    """The outflow that the first device measures flows into the second tank, which has no outlet: no water is lost."""
    system = tank_site(tmp_path)
    build_fmu(tmp_path / "lower.fmu", 3)
    text = system.read_text()
    system.write_text(
        text.replace("  pump:", "  lower: {profile: ./level.yaml, bus: line1, unit: 3, poll: {values: {every_ms: 250}}}\n  pump:")
    )  # fmt: skip
    in_prototype(
        system,
        "devices:\n",
        "  basin:\n    fmu: lower.fmu\n    step_ms: 50\n    variables: {outlet: outlet.k}\n"
        "    start: {level: 0.2, area: 0.8, outlet: 0}\n    inputs: {inflow: sensor.outflow}\n"
        "devices:\n  lower: {simulation: basin}\n",
    )
    result = scenario(
        system, "virtual", 'wait: {until: "lower.level > 0.5", within: 15s}',
        'expect: {that: "sensor.level + lower.level > 1.66 and sensor.level + lower.level < 1.74", during: 1s}',
    )  # fmt: skip
    assert result.verdict is Verdict.PASSED, result


def canopen_site(folder: Path, fails: str = "") -> Path:
    """Return a system with a CANopen node whose TPDO carries the level of the FMU."""
    system = own_system(folder)
    system.write_text(
        system.read_text().replace("node: 5,", "node: 5, tpdo1: {map: [slope_long, slope_lateral], event_ms: 100},")
    )
    build_fmu(system.with_name("tank.fmu"), fails=fails)
    prototype = system.with_name("dam.prototype.yaml")
    text = prototype.read_text().replace(
        "{recording: tilt.jsonl, at_end: loop}", "{simulation: water, plays: {slope_long: level}}"
    )
    prototype.write_text(text + "simulations: {water: {fmu: tank.fmu, start: {level: 1.5, pump: 1}}}\n")
    return system


def test_an_object_of_a_canopen_node_has_the_value_of_an_fmu(tmp_path: Path) -> None:
    system = canopen_site(tmp_path / "site")
    result = scenario(
        system, "virtual", 'wait: {until: "tilt.slope_long > 1.5", within: 5s}',
        'wait: {until: "tilt.slope_long > 2.2", within: 30s}',
    )  # fmt: skip
    assert result.verdict is Verdict.PASSED, result


@pytest.mark.parametrize(
    ("fails", "message"),
    [
        ("crash", "its process has ended during the step to 0.7 s: SIGSEGV"),
        ("error", "the step to 0.7 s failed: fmi2DoStep failed with status 3"),
        ("not a number", "the output 'outflow' is nan at 0.7 s"),
        ("endless", "the step to "),
    ],
)
def test_failure_makes_the_device_silent_and_the_scenario_an_error(tmp_path: Path, fails: str, message: str) -> None:
    system = tank_site(tmp_path, fails=fails)
    in_prototype(system, "step_ms: 100", "step_ms: 100\n    limit_ms: 3000")
    result = scenario(system, "virtual", *LOST)
    assert [check.verdict for check in result.checks[:2]] == [Verdict.PASSED] * 2, result.checks
    assert result.verdict is Verdict.ERROR, result
    assert f"tank.fmu: the FMU of the simulation 'water' failed: {message}" in result.reason


@pytest.mark.long
def test_failure_makes_a_scenario_in_real_time_an_error_too(tmp_path: Path) -> None:
    result = scenario(tank_site(tmp_path, fails="crash"), "local", 'expect: {that: "sensor.level > 0", during: 5s}')
    assert result.verdict is Verdict.ERROR, result
    assert "during the step to 0.7 s: SIGSEGV" in result.reason


def test_run_with_a_failed_fmu_is_not_ok_and_publishes_nothing_of_the_failed_step(tmp_path: Path) -> None:
    run = VirtualRun(VirtualOptions(str(tank_site(tmp_path, fails="crash")), 10.0, trace=tmp_path / "trace.jsonl"))
    run.run()
    summary = run.summary()
    assert not summary["ok"]
    assert any("during the step to 0.7 s: SIGSEGV" in error for error in summary["errors"])
    assert summary["virtual_s"] == 10.0
    events = [json.loads(line) for line in (tmp_path / "trace.jsonl").read_text().splitlines()]
    after = [
        data["quality"] for t_ns, kind, name, data in events if (kind, name) == ("tag", "sensor.level") and t_ns > 0.7e9
    ]
    assert after, "the loss of the sensor is published"
    assert set(after) == {"bad"}
    asked = [
        t_ns for t_ns, kind, _, data in events if kind == "frame" and data["bytes"].startswith("02") and t_ns > 5e9
    ]
    assert asked, "the other device still answers"


def test_failed_fmu_makes_a_canopen_node_silent(tmp_path: Path) -> None:
    system = canopen_site(tmp_path / "site", fails="crash")
    result = scenario(system, "virtual", """wait: {until: "quality(tilt.slope_long) == 'bad'", within: 20s}""")
    assert result.checks[0].verdict is Verdict.PASSED, result.checks
    assert result.verdict is Verdict.ERROR, result
    frames = [event.t_ns for event in result.trace if event.kind is TraceKind.FRAME and event.data.get("id") == 0x185]
    assert frames
    assert max(frames) < 0.8e9, "no TPDO with values of the failed model"


def test_an_fmu_of_a_template_runs_after_a_confirmation_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FIELDTWIN_RUN", str(tmp_path / "run"))
    system, zipped = tank_site(tmp_path / "site"), tmp_path / "T.zip"
    prototype = system.with_name("tank.prototype.yaml")
    for argv in (
        ["template", "pack", str(system), "-o", str(zipped), "--prototype-file", str(prototype)],
        ["simulate", str(zipped), "--for", "1s"],
        ["simulate", str(zipped), "--for", "1s", "--trust"],
    ):
        ended = CliRunner().invoke(cli, argv, standalone_mode=False)
        if argv[-1] == "1s":
            assert "contains FMUs, which are native code: systems/tank.fmu" in ended.stderr
            assert "nothing of this template was run" in str(ended.exception)
        else:
            assert ended.exit_code == 0, (ended.output, ended.exception)
