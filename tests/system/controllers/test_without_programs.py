"""A system without `plc:` is whole: a gateway alone, simulated devices for a controller of the user's own, or both.

Every command takes it, and no view speaks of a PLC that has nothing to do.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest
from click.testing import CliRunner
from procs import fieldtwin, free_port, no_tracebacks, run_to_end, wait_for

from fieldtwin.cli.main import cli

SITE = """fieldtwin: 1
system: site
buses: {lan: {url: "tcp://127.0.0.1:PORT", timeout_ms: 500}}
devices: {meter: {profile: eastron-sdm630, bus: lan, unit: 1, poll: {fast: {every_ms: 100}, slow: {every_ms: 500}}}}
serve: {hmi: {url: "tcp://127.0.0.1:0", tags: {meter.power: {input: 0}}}}
"""
PROTOTYPE = """prototype_of: site.yaml
buses: {lan: {listen: "tcp://127.0.0.1:0"}}
devices: {meter: {model: profile}}
"""
SCENARIO = """scenario: a silent meter is noticed
system: site.yaml
steps:
  - wait: {until: "quality(meter.power) == 'good'", within: 5s}
  - fault: {name: silence, device: meter, from: 0s, until: 20s}
  - wait: {until: "quality(meter.power) == 'bad'", within: 10s}
"""
READER = """
import os
from pymodbus.client import ModbusTcpClient
meter = ModbusTcpClient(os.environ["FIELDTWIN_LAN_HOST"], port=int(os.environ["FIELDTWIN_LAN_PORT"]))
assert meter.connect()
print(len(meter.read_input_registers(52, count=2, device_id=int(os.environ["FIELDTWIN_METER_UNIT"])).registers))
"""


@pytest.fixture
def site(tmp_path: Path) -> Path:
    (tmp_path / "site.yaml").write_text(SITE.replace("PORT", str(free_port())), encoding="utf-8")
    (tmp_path / "site.prototype.yaml").write_text(PROTOTYPE, encoding="utf-8")
    (tmp_path / "silent.scenario.yaml").write_text(SCENARIO, encoding="utf-8")
    return tmp_path / "site.yaml"


@pytest.mark.long
def test_its_prototype_runs_and_no_view_speaks_of_a_plc(site: Path, tmp_path: Path) -> None:
    ended = run_to_end(tmp_path / "r", "run", str(site), "--prototype", "--for", "7s")
    assert ended.process.returncode == 0, ended.err
    assert ended.out.rstrip().endswith("ok")
    assert "serve hmi  ←  " in ended.err
    assert "meter=good" in ended.err
    assert "scans=" not in ended.err
    assert "PLC" not in ended.err + ended.out
    no_tracebacks(tmp_path / "r")


@pytest.mark.long
def test_the_same_file_runs_a_plant(site: Path, tmp_path: Path) -> None:
    port = site.read_text(encoding="utf-8").partition("127.0.0.1:")[2].partition('"')[0]
    with fieldtwin(
        tmp_path / "d", "emulate", "eastron-sdm630", "--on", f"tcp://127.0.0.1:{port}", name="device"
    ) as device:
        wait_for(lambda: f":{port}" in device.err + device.out, what="the device listens")
        ended = run_to_end(tmp_path / "r", "run", str(site), "--plant", "--for", "2s", "--json")
        assert ended.process.returncode == 0, ended.err
        summary = json.loads(ended.out)
        assert summary["devices"]["meter"]["state"] == "good"
        assert summary["published"]["values"] > 0
        assert summary["states"] == {}


@pytest.mark.parametrize("target", ["virtual", "local"])
def test_its_scenarios_run(site: Path, tmp_path: Path, target: str) -> None:
    scenario = str(tmp_path / "silent.scenario.yaml")
    ended = run_to_end(tmp_path / "r", "test", scenario, "--target", target)
    assert ended.process.returncode == 0, ended.out + ended.err
    assert "1 passed" in ended.out


@pytest.mark.interop
def test_a_controller_of_the_users_own_gets_the_simulated_devices(site: Path, tmp_path: Path) -> None:
    ended = run_to_end(tmp_path / "r", "with", str(site), "--", sys.executable, "-c", READER)
    assert ended.process.returncode == 0, ended.err
    assert ended.out.strip() == "2"


def test_its_drawing_has_no_plc(site: Path) -> None:
    drawn = CliRunner().invoke(cli, ["draw", str(site)], standalone_mode=False, catch_exceptions=False)
    assert "meter" in drawn.stdout
    assert "plc" not in drawn.stdout
