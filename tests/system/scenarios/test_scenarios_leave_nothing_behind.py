"""Scenarios on a running system inject faults and values, and leave none of them.

Defect: after `--target compose`, the faults and set values of a scenario that failed or was killed stayed in the simulated
devices. Later scenarios ran on a manipulated system, and the second run ended with "the fault is in already".
"""

from __future__ import annotations

import json
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from procs import Asking, Fieldtwin, every_device_online, fieldtwin, free_port, no_tracebacks, run_to_end, wait_for

pytestmark = [pytest.mark.long, pytest.mark.timeout(400)]
EXPECTED = {"calm": "passed", "deep": "passed", "silent": "passed", "wrong": "failed"}
ORDERS = [("deep", "calm", "wrong", "silent"), ("silent", "wrong", "deep", "calm")]

SYSTEM = """fieldtwin: 1
system: shed
buses: {lan: {url: "tcp://tank:502", timeout_ms: 500}}
devices:
  tank:
    profile: tank.yaml
    bus: lan
    unit: 1
    poll: {values: {every_ms: 100}}
    writable: [valve]
    safe: {valve: 0}
plc:
  cycle_ms: 50
  watchdog: {late_ms: 1000, stop_after: 100}
  programs:
    guard:
      source: guard.st
      inputs: {level: {tag: tank.level, if_bad: hold}}
      outputs: {valve: tank.valve}
"""
TANK = """device: own/tank
source: "this test"
protocol: modbus
numbering: printed
defaults: {poll: values}
tags:
  level: {at: 30001, type: uint16, range: [0, 500]}
  filled: {at: 30002, type: uint16}
  valve: {at: 40001, type: uint16, access: rw, range: [0, 1]}
"""
PROTOTYPE = """prototype_of: shed.yaml
buses: {lan: {listen: "tcp://127.0.0.1:0"}}
devices: {tank: {simulation: water}}
simulations:
  water:
    step_ms: 100
    inputs: {open: tank.valve}
    formulas: {level: "20", filled: "min(1000, filled + 100 * open * dt)"}
"""
GUARD = """PROGRAM guard
  VAR_INPUT level : REAL; END_VAR
  VAR_OUTPUT valve : INT; END_VAR
  VAR RETAIN tripped : BOOL; END_VAR
  IF level > 100.0 THEN tripped := TRUE; END_IF;
  IF tripped THEN valve := 1; ELSE valve := 0; END_IF;
END_PROGRAM
"""
WITHIN = "within: 60s"
"""Generous, because the test is about the result, and the host may be busy."""
SCENARIOS = {
    "calm": f"""
start: fresh
steps:
  - expect: {{that: "tank.level == 20 and not guard.tripped and tank.valve == 0 and tank.filled == 0", {WITHIN}}}
""",
    "deep": f"""
start: fresh
steps:
  - set: {{tag: tank.level, value: 120}}
  - expect: {{that: "guard.tripped and tank.valve == 1 and tank.filled > 0", {WITHIN}}}
""",
    "silent": f"""
start: fresh
steps:
  - expect: {{tag: tank.level, quality: good, {WITHIN}}}
  - fault: {{name: silence, device: tank}}
  - expect: {{tag: tank.level, quality: bad, {WITHIN}}}
""",
    "wrong": f"""
start: fresh
steps:
  - expect: {{tag: tank.level, quality: good, {WITHIN}}}
  - fault: {{name: stuck, device: tank, register: level}}
  - set: {{tag: tank.level, value: 60}}
  - expect: {{that: "guard.tripped", within: 3s}}
""",
}
HANGING = """scenario: it hangs
system: shed.yaml
steps:
  - fault: {id: dead, name: silence, device: tank}
  - set: {tag: tank.level, value: 120}
  - pause: 600s
"""


@pytest.fixture
def site(tmp_path: Path) -> Path:
    (tmp_path / "shed.yaml").write_text(SYSTEM)
    (tmp_path / "tank.yaml").write_text(TANK)
    (tmp_path / "shed.prototype.yaml").write_text(PROTOTYPE)
    (tmp_path / "guard.st").write_text(GUARD)
    for name, text in SCENARIOS.items():
        (tmp_path / f"{name}.scenario.yaml").write_text(f"scenario: {name}\nsystem: shed.yaml{text}")
    (tmp_path / "hanging.scenario.yaml").write_text(HANGING)
    return tmp_path


class Running:
    """A field simulator and a controller that run, as in two containers, and the options that tell `fieldtwin test` their
    addresses."""

    def __init__(self, site: Path, field: Fieldtwin, run: Fieldtwin, port: int) -> None:
        self.site = site
        self.field = Asking(("127.0.0.1", port))
        self.plc = run.control("shed", "plc")
        self.gateway = run.control("shed", "gateway")
        self.words = ("--target", "compose", "--field", f"127.0.0.1:{port}", "--json")

    def test(self, *names: str, name: str = "test") -> list[dict[str, Any]]:
        files = [str(self.site / f"{one}.scenario.yaml") for one in names]
        ended = run_to_end(self.site, "test", *files, *self.words, name=name, within_s=300)
        assert ended.out, ended.err
        results: list[dict[str, Any]] = json.loads(ended.out)
        return results

    def put_in(self) -> tuple[list[str], dict[str, float]]:
        """Return the ids of faults and the set values that are now in the devices."""
        status = self.field("get")
        return [fault["id"] for fault in status["faults"]], status["set"]


@pytest.fixture
def running(site: Path) -> Iterator[Running]:
    port = free_port()
    emulate = ("emulate", str(site / "shed.yaml"), "--control", f"127.0.0.1:{port}")
    run = ("run", str(site / "shed.yaml"), "--prototype", "--field", f"127.0.0.1:{port}")
    with fieldtwin(site, *emulate, name="field") as field:
        wait_for(lambda: "now: fieldtwin run" in field.err, 30, "the field simulator is up")
        with fieldtwin(site, *run) as controller:
            every_device_online(controller.control("shed", "gateway"))
            yield Running(site, field, controller, port)
    no_tracebacks(site)


def verdicts(results: list[dict[str, Any]]) -> dict[str, str]:
    return {result["name"]: result["verdict"] for result in results}


def test_nothing_stays_in_after_a_failed_scenario(running: Running) -> None:
    running.field("set", device="tank", tag="level", value=33)
    (result,) = running.test("wrong")
    assert result["verdict"] == "failed", result
    assert running.put_in() == ([], {})
    (again,) = running.test("wrong", name="again")
    assert again["verdict"] == "failed", again
    assert "in already" not in json.dumps(again)


def test_a_value_set_by_the_user_is_restored_after_the_scenario(running: Running) -> None:
    running.field("set", device="tank", tag="level", value=33)
    running.field("fault", fault={"id": "mine", "name": "delay", "device": "tank"})
    (running.site / "over.scenario.yaml").write_text(
        "scenario: over\nsystem: shed.yaml\nsteps:\n  - set: {tag: tank.level, value: 44}\n"
        "  - expect: {that: 'tank.level == 44', within: 60s}\n  - set: {tag: tank.level, value: null}\n"
        "  - expect: {that: 'tank.level == 21', within: 1s}\n"
    )
    (result,) = running.test("over")
    assert result["verdict"] in ("failed", "inconclusive"), result
    assert "these faults were already active: the fault 'mine' (delay), tank.level set to 33" in result["reason"]
    assert running.put_in() == (["mine"], {"tank.level": 33})


def test_a_killed_judge_s_faults_and_values_expire(running: Running) -> None:
    hanging = str(running.site / "hanging.scenario.yaml")
    with fieldtwin(running.site, "test", hanging, *running.words, name="hanging") as judge:
        wait_for(lambda: running.put_in() == (["dead"], {"tank.level": 120}), 30, judge.err)
        judge.signal(signal.SIGKILL)
        judge.wait()
    results = running.test("calm", "silent")  # at once: this scenario waits for the lease of the killed one
    assert verdicts(results) == {"calm": "passed", "silent": "passed"}, results
    assert running.put_in() == ([], {})
    assert running.field("get")["lease"]["expired"] == 1


def test_a_terminated_test_removes_its_faults_and_values_at_once(running: Running) -> None:
    hanging = str(running.site / "hanging.scenario.yaml")
    with fieldtwin(running.site, "test", hanging, *running.words, name="hanging") as judge:
        wait_for(lambda: running.put_in() == (["dead"], {"tank.level": 120}), 30, judge.err)
        judge.signal(signal.SIGTERM)
        judge.wait()
    assert running.put_in() == ([], {})
    assert running.field("get")["lease"] == {"held": None, "expired": 0}


@pytest.mark.parametrize("order", ORDERS)
def test_any_order_gives_the_same_verdicts_on_compose(running: Running, order: tuple[str, ...]) -> None:
    running.plc("force", tag="tank.valve", value=1, by="a person")
    results = running.test(*order)
    assert verdicts(results) == EXPECTED, results


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("target", ["virtual", "local"])
def test_any_order_gives_the_same_verdicts_on_virtual_and_local(
    site: Path, target: str, order: tuple[str, ...]
) -> None:
    files = [str(site / f"{one}.scenario.yaml") for one in order]
    ended = run_to_end(site, "test", *files, "--target", target, "--json", within_s=300)
    assert verdicts(json.loads(ended.out)) == EXPECTED


def test_a_plant_and_a_foreign_controller_have_no_fresh_start(running: Running) -> None:
    ended = run_to_end(running.site, "test", str(running.site / "calm.scenario.yaml"), "--target", "real", "--json")
    (result,) = json.loads(ended.out)
    assert result["verdict"] == "skipped"
    assert "cannot fresh_start" in result["reason"]
    assert "the PLC is fieldtwin's" in result["reason"]


OBSERVATORY = """scenario: from standby to sampling every second
system: observatory
start: fresh
steps:
  - expect: {that: "relay.state == 'STANDBY' and quality(ctd.status) == 'good'", within: 60s}
  - send: {period_s: 1}
  - expect: {that: "relay.state == 'ACTIVE' and ctd.sample_period_s == 1", within: 60s}
"""


def test_a_line_a_can_bus_and_a_modem_are_rebuilt(tmp_path: Path) -> None:
    """A serial line, CANopen nodes and a transmitter whose mailboxes were used: the second run starts like the first."""
    port = free_port()
    scenario = tmp_path / "scenarios" / "a.scenario.yaml"
    scenario.parent.mkdir()
    scenario.write_text(OBSERVATORY)
    emulate = ("emulate", "observatory", "--control", f"127.0.0.1:{port}")
    run = ("run", "observatory", "--prototype", "--field", f"127.0.0.1:{port}", "--commands", "none")
    with fieldtwin(tmp_path, *emulate, name="field") as field:
        wait_for(lambda: "now: fieldtwin run" in field.err, 30, "the field simulator is up")
        with fieldtwin(tmp_path, *run) as controller:
            every_device_online(controller.control("observatory", "gateway"))
            for name in ("first", "second"):
                words = ("--target", "compose", "--field", f"127.0.0.1:{port}", "--json")
                ended = run_to_end(tmp_path, "test", str(scenario), *words, name=name, within_s=200)
                (result,) = json.loads(ended.out)
                assert result["verdict"] == "passed", result
            assert controller.process.poll() is None
    no_tracebacks(tmp_path)
