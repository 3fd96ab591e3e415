"""One scenario on other targets: processes on this host, a plant. Impossible or forbidden scenarios are skipped, not passed."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from procs import Fieldtwin, fieldtwin, free_port, no_tracebacks, run_to_end, wait_for

EVERYTHING = """
scenario: everything at once
system: observatory
seed: 4
probes:
  desk: {serve: hmi, every: 100ms, registers: {temperature: {at: 30005, type: float32}}}
always: ["quality(ctd.pressure) != 'good' or age(ctd.pressure) <= 3 s"]
within: [{after: "relay.state == 'ACTIVE'", then: "ctd.sample_period_s == 1", within: 8s}]
rate: [{wire: ctd, requests_per_s: {max: 20}, over: 2s}]
steps:
  - send: {period_s: 1}
  - wait: {until: "quality(ctd.pressure) == 'good'", within: 20s}
  - expect: {wire: ctd, function: 16, register: sample_period_s, value: 1, times: 1, within: 100ms}
  - set: {tag: ctd.temperature, value: 50}
  - expect: {tag: desk.temperature, value: 50, tolerance: 0.01, quality: good, within: 8s}
  - fault: {id: dead, name: silence, device: ctd}
  - expect: {tag: ctd.pressure, quality: bad, within: 5s}
  - clear: dead
  - expect: {tag: ctd.pressure, quality: good, like: recording, tolerance: 0.01, within: 15s}
"""


def judged(ended: Fieldtwin) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(ended.out)[0]
    return found


def test_a_scenario_runs_unchanged_as_processes(tmp_path: Path) -> None:
    path = tmp_path / "e.scenario.yaml"
    path.write_text(EVERYTHING)
    ended = run_to_end(tmp_path, "test", str(path), "--target", "local", "--json", within_s=90)
    result = judged(ended)
    late = any("late by itself" in check["got"] for check in result["checks"])
    assert (result["verdict"], ended.process.returncode) == (("inconclusive", 1) if late else ("passed", 0)), result
    assert result["target"] == "local"
    assert result["reproduce"] == f"fieldtwin test {path} --target local"
    assert not list(tmp_path.glob("test-*")), "the run directory is gone"
    no_tracebacks(tmp_path)


@pytest.mark.long
def test_a_failing_expectation_fails_there_too(tmp_path: Path) -> None:
    path = tmp_path / "f.scenario.yaml"
    path.write_text(
        "scenario: f\nsystem: observatory\nsteps:\n  - expect: {tag: relay.state, value: 'OFF', within: 2s}\n"
    )
    ended = run_to_end(tmp_path, "test", str(path), "--target", "local", "--json", within_s=60)
    result = judged(ended)
    assert ended.process.returncode == 1
    assert result["verdict"] in ("failed", "inconclusive")
    assert "STANDBY" in result["checks"][0]["got"]


PLANT = """fieldtwin: 1
system: shed
buses: {{lan: {{url: "tcp://127.0.0.1:{port}", timeout_ms: 1000}}}}
devices:
  ctd: {{profile: ctd-reference, bus: lan, unit: 1, poll: {{values: {{every_ms: 500}}, status: {{every_ms: 200}}}}}}
plc: {{programs: {{lamp: {{source: "python: shed_lamp:Lamp", inputs: {{status: {{tag: ctd.status}}}}}}}}}}
"""
LAMP = """from fieldtwin.gateway.core.image.image import TagKind
from fieldtwin.plc.program import Program, ScanInfo, var_input, var_local


class Lamp(Program):
    status: int | None = var_input(TagKind.INT)
    lit: bool = var_local(TagKind.BOOL, initial=False)

    def execute(self, scan: ScanInfo) -> None:
        self.lit = self.status == 0
"""
OBSERVING = """scenario: the sensor is in standby
system: shed.yaml
probes:
  direct: {{endpoint: "tcp://127.0.0.1:{port}", every: 100ms, registers: {{status: {{at: 40001}}}}}}
steps:
  - expect: {{tag: ctd.status, value: 0, quality: good, within: 10s}}
  - expect: {{that: "direct.status == ctd.status", within: 5s}}
  - expect: {{wire: ctd, function: 3, within: 1s}}
  - expect: {{that: "lamp.lit", within: 2s}}
"""
TOUCHING = """scenario: {what}
system: shed.yaml
steps:
  - {step}
"""


@pytest.mark.long
def test_a_plant_is_only_observed(tmp_path: Path) -> None:
    port = free_port()
    (tmp_path / "shed.yaml").write_text(PLANT.format(port=port))
    (tmp_path / "shed_lamp.py").write_text(LAMP)
    (tmp_path / "a.scenario.yaml").write_text(OBSERVING.format(port=port))
    steps = {
        "b": "set: {tag: ctd.pressure, value: 1}",
        "c": "fault: {name: silence, device: ctd}",
        "d": "send: {period_s: 1}",
    }
    for name, step in steps.items():
        (tmp_path / f"{name}.scenario.yaml").write_text(TOUCHING.format(what=name, step=step))
    words = ["test", str(tmp_path), "--target", "real"]
    with fieldtwin(tmp_path, "emulate", "ctd-reference", "--on", f"tcp://127.0.0.1:{port}", name="field") as field:
        wait_for(lambda: str(port) in field.err + field.out, 20, "the sensor is up")
        ended = run_to_end(tmp_path, *words, "--json", within_s=60)
        observed = run_to_end(tmp_path, *words, "--allow", "observe", "--json", name="observed", within_s=60)
    results = {result["name"]: result for result in json.loads(ended.out)}
    assert results["the sensor is in standby"]["verdict"] == "passed", results
    for name, word in (("b", "set_value"), ("c", "inject_fault"), ("d", "send_command")):
        assert results[name]["verdict"] == "skipped"
        assert f"cannot {word}" in results[name]["reason"]
    assert ended.process.returncode == 1, "what was skipped has not passed"
    assert "allows observe" in json.loads(observed.out)[0]["reason"]
    no_tracebacks(tmp_path)
