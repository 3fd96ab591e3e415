"""Alarms of a system in virtual time: delays, acknowledgement, quality, the trace, and the same trace in every run."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from fieldtwin.cli.run.summary_view import print_summary
from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.results.model import ScenarioResult, Verdict
from fieldtwin.results.trace import TraceEvent, TraceKind
from fieldtwin.run.targets.scenario_targets import ScenarioTarget, run_scenario
from fieldtwin.run.targets.virtual_scenario import run_virtual
from fieldtwin.run.virtual.run import VirtualOptions, VirtualRun
from fieldtwin.scenarios.language.form import load_scenario
from tests.tank_plant import PLANT, write_plant

SYSTEMS = Path(__file__).parents[2] / "profiles" / "systems"
EXAMPLE = Path(__file__).parents[2] / "examples" / "alarms"
PUMP = """PROGRAM Pump
VAR_INPUT level : INT; END_VAR
VAR full : BOOL; END_VAR
  full := level > 90;
END_PROGRAM
"""
ALARMS = """alarms:
  high: {condition: "sensor.level > 80", priority: high, text: "Level is high", on_delay_ms: 2000, off_delay_ms: 1000}
  full: {condition: "pump.full", acknowledge: false}
  lost: {condition: "quality(sensor.level) == 'bad'", priority: critical, on_delay_ms: 500}
"""
READY = "  - wait: {until: \"alarm.high == 'normal' and quality(alarm.high) == 'good'\", within: 5s}\n"
RISES = "  - set: {tag: sensor.level, value: 85}\n"


def scenario(folder: Path, steps: str, alarms: str = ALARMS) -> Path:
    write_plant(folder, PLANT + alarms)
    (folder / "pump.st").write_text(PUMP)
    path = folder / "x.scenario.yaml"
    path.write_text(f"scenario: alarms\nsystem: plant.yaml\nsteps:\n{steps}")
    return path


def run(folder: Path, steps: str, alarms: str = ALARMS) -> ScenarioResult:
    return run_virtual(load_scenario(scenario(folder, steps, alarms)))


def states(result: ScenarioResult, alarm: str) -> list[tuple[str, str, str]]:
    """Return state, quality and user of each change of an alarm in the trace."""
    events = [e.data for e in result.trace if e.kind is TraceKind.ALARM and e.where == f"alarm.{alarm}"]
    return [(data["value"], data["quality"], data["by"]) for data in events]


def test_an_alarm_is_raised_after_its_delay_acknowledged_and_returns_to_normal(tmp_path: Path) -> None:
    steps = (
        READY
        + RISES
        + "  - expect: {that: \"alarm.high == 'normal'\", during: 1500ms}\n"
        + "  - expect: {tag: alarm.high, value: active_unacknowledged, quality: good, within: 1s, during: 3s}\n"
        + "  - acknowledge: alarm.high\n"
        + "  - expect: {tag: alarm.high, value: active_acknowledged}\n"
        + "  - set: {tag: sensor.level, value: 42}\n"
        + "  - expect: {that: \"alarm.high == 'active_acknowledged'\", during: 800ms}\n"
        + "  - expect: {tag: alarm.high, value: normal, within: 1s}\n"
    )
    result = run(tmp_path, steps)
    assert result.verdict is Verdict.PASSED, result.checks[-1]
    assert states(result, "high") == [
        ("normal", "good", ""),
        ("active_unacknowledged", "good", ""),
        ("active_acknowledged", "good", "scenario"),
        ("normal", "good", ""),
    ]


def test_an_alarm_that_returns_before_acknowledgement_waits_for_it(tmp_path: Path) -> None:
    steps = (
        READY
        + RISES
        + "  - wait: {until: \"alarm.high == 'active_unacknowledged'\", within: 5s}\n"
        + "  - set: {tag: sensor.level, value: 42}\n"
        + "  - expect: {tag: alarm.high, value: returned_unacknowledged, within: 2s, during: 10s}\n"
        + "  - acknowledge: alarm.high\n"
        + "  - expect: {tag: alarm.high, value: normal}\n"
    )
    result = run(tmp_path, steps)
    assert result.verdict is Verdict.PASSED, result.checks[-1]


def test_an_alarm_on_a_variable_of_a_program_without_acknowledgement(tmp_path: Path) -> None:
    steps = (
        "  - wait: {until: \"alarm.full == 'normal'\", within: 5s}\n"
        "  - set: {tag: sensor.level, value: 95}\n"
        "  - expect: {tag: alarm.full, value: active_acknowledged, within: 1s}\n"
        "  - set: {tag: sensor.level, value: 50}\n"
        "  - expect: {tag: alarm.full, value: normal, within: 1s}\n"
    )
    result = run(tmp_path, steps)
    assert result.verdict is Verdict.PASSED, result.checks[-1]


def test_a_lost_sensor_makes_the_quality_bad_and_keeps_the_state(tmp_path: Path) -> None:
    steps = (
        READY
        + RISES
        + "  - wait: {until: \"alarm.high == 'active_unacknowledged'\", within: 5s}\n"
        + "  - fault: {id: gone, name: silence, device: sensor}\n"
        + "  - expect: {tag: alarm.high, value: active_unacknowledged, quality: bad, within: 10s, during: 3s}\n"
        + "  - expect: {tag: alarm.lost, value: active_unacknowledged, quality: good}\n"
        + "  - expect: {tag: alarm.high, value: active_unacknowledged, quality: good, within: 15s}\n"
        + "  - expect: {tag: alarm.lost, value: returned_unacknowledged, within: 1s}\n"
    )
    result = run(tmp_path, steps)
    assert result.verdict is Verdict.PASSED, result.checks[-1]
    assert ("active_unacknowledged", "bad", "") in states(result, "high")


def test_two_runs_of_one_seed_have_the_same_trace(tmp_path: Path) -> None:
    steps = READY + RISES + "  - expect: {tag: alarm.high, value: active_unacknowledged, within: 3s}\n  - pause: 1min\n"
    first, second = run(tmp_path, steps), run(tmp_path, steps)
    assert first.verdict is Verdict.PASSED, first.checks[-1]
    assert first.trace_hash == second.trace_hash
    [raised] = [e for e in first.trace if e.kind is TraceKind.ALARM and e.data["value"] == "active_unacknowledged"]
    [risen] = [e for e in first.trace if e.kind is TraceKind.TAG and e.data["value"] == 85][:1]
    cycle_ns = 50_000_000
    assert 2_000_000_000 <= raised.t_ns - risen.t_ns <= 2_000_000_000 + 2 * cycle_ns


def test_a_delay_ends_in_time_while_nothing_else_happens(tmp_path: Path) -> None:
    """A run in virtual time skips cycles in which nothing changes, and must not skip the end of a delay."""
    alarms = "alarms:\n  high: {condition: sensor.level > 40, on_delay_ms: 7300}\n"
    slow = PLANT.replace("every_ms: 100}}", "every_ms: 60000}}, stale_after_ms: 600000")
    write_plant(tmp_path, slow + alarms)
    (tmp_path / "pump.st").write_text(PUMP)
    changes: list[TraceEvent] = []
    run = VirtualRun(VirtualOptions(str(tmp_path / "plant.yaml"), 30.0))
    run.run(watch=lambda trace: trace.listen(changes.append, TraceKind.ALARM))
    known, raised = changes
    assert (raised.data["value"], raised.t_ns - known.t_ns) == ("active_unacknowledged", 7_300_000_000)


def test_the_summary_of_a_run_names_the_alarms_that_need_attention(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_plant(tmp_path, PLANT + ALARMS)
    (tmp_path / "pump.st").write_text(PUMP)
    prototype = tmp_path / "plant.prototype.yaml"
    prototype.write_text(prototype.read_text().replace("level: 42", "level: 85"))
    run = VirtualRun(VirtualOptions(str(tmp_path / "plant.yaml"), 10.0))
    run.run()
    summary = run.summary()
    assert {name: alarm["state"] for name, alarm in summary["alarms"].items()} == {
        "high": "active_unacknowledged", "full": "normal", "lost": "normal",
    }  # fmt: skip
    print_summary(summary)
    lines = [line.split(maxsplit=1) for line in capsys.readouterr().out.splitlines()]
    assert [text for word, *rest in lines if word == "alarm" for text in rest] == [
        "high: active unacknowledged, good: Level is high"
    ]


def test_alarms_of_a_system_in_a_network_have_its_name_before_them(tmp_path: Path) -> None:
    for path in SYSTEMS.glob("ocean_*"):
        shutil.copy(path, tmp_path)
    shutil.copy(SYSTEMS / "adapt.st", tmp_path)
    east = tmp_path / "ocean_east.yaml"
    east.write_text(east.read_text() + 'alarms:\n  on: {condition: "current.sample_period_s >= 0"}\n')
    steps = (
        "  - wait: {until: \"east.alarm.on == 'active_unacknowledged'\", within: 30s}\n"
        "  - acknowledge: east.alarm.on\n"
        "  - expect: {tag: east.alarm.on, value: active_acknowledged, within: 1s, during: 3s}\n"
    )
    path = tmp_path / "x.scenario.yaml"
    path.write_text(f"scenario: alarms\nsystem: ocean_network.yaml\nsteps:\n{steps}")
    result = run_scenario(load_scenario(path), ScenarioTarget())
    assert result.verdict is Verdict.PASSED, result.checks[-1]


@pytest.mark.long
@pytest.mark.timeout(180)
@pytest.mark.parametrize("name", ["high", "lost"])
def test_the_example_passes_in_real_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    shutil.copytree(EXAMPLE, tmp_path / "site")
    monkeypatch.setenv("FIELDTWIN_RUN", str(tmp_path / "r"))
    result = run_scenario(load_scenario(tmp_path / "site" / f"{name}.scenario.yaml"), ScenarioTarget("local"))
    assert result.verdict is Verdict.PASSED, result.checks[-1]
    assert ("active_unacknowledged", "good", "") in states(result, "level_high" if name == "high" else "level_unknown")


def test_an_acknowledgement_that_makes_no_sense_is_an_error(tmp_path: Path) -> None:
    result = run(tmp_path, READY + "  - acknowledge: alarm.high\n")
    assert result.verdict is Verdict.ERROR
    assert "nothing to acknowledge" in result.checks[-1].got


@pytest.mark.parametrize(
    ("steps", "expected"),
    [
        ("  - acknowledge: alarm.hihg\n", "no alarm 'alarm.hihg'"),
        ("  - expect: {tag: alarm.high, value: aktive}\n", "no value of alarm.high 'aktive'"),
        ("  - expect: {that: \"alarm.low == 'normal'\"}\n", "no tag or variable 'alarm.low'"),
        ("  - expect: {tag: alarm.hihg, value: normal}\n", "no tag 'alarm.hihg'.*did you mean 'alarm.high'"),
        ("  - wait: {until: \"alarm.low == 'normal'\"}\n", "no tag or variable 'alarm.low'"),
        ("  - expect: {tag: alarm.high, value: 1}\n", "the state of alarm.high; expected normal, active_.*; got 1"),
        ("  - set: {tag: alarm.high, value: normal}\n", "'alarm.high' is an alarm, which cannot be set"),
        ("  - pause: 1s\nrefused: [alarm.high]\n", "'alarm.high' is an alarm, which cannot be written"),
    ],
)
def test_unknown_alarms_and_states_in_scenarios(tmp_path: Path, steps: str, expected: str) -> None:
    with pytest.raises(FileInvalid, match=expected):
        load_scenario(scenario(tmp_path, steps))
