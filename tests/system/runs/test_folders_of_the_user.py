"""A user's working directory has packages named gateway, plc, emulators, twin and tests, as a controls engineer's often has.

Ours are `fieldtwin.gateway` and so on, so that neither hides the other: every command runs, and `python: plc.control:Pump` is
the user's program. The same holds if a different installed distribution contains a module `gateway`.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

CHECKOUT = Path(__file__).resolve().parents[3]
NOT_OURS = 'raise ImportError("a module of the user was taken for one of fieldtwin")\n'
PUMP = """from fieldtwin.gateway.core.image.image import TagKind
from fieldtwin.plc.program import Program, ScanInfo, var_input, var_output


class Pump(Program):
    level: float | None = var_input(TagKind.REAL)
    valve: int = var_output(TagKind.INT, initial=0)

    def execute(self, scan: ScanInfo) -> None:
        self.valve = 1 if self.level > 100.0 else 0
"""
PROFILE = """device: own/tank
source: "this test"
protocol: modbus
numbering: printed
defaults: {poll: values}
tags:
  level: {at: 30001, type: uint16, range: [0, 500]}
  valve: {at: 40001, type: uint16, access: rw, range: [0, 1]}
"""
SYSTEM = """fieldtwin: 1
system: shed
buses: {lan: {url: "tcp://tank:502", timeout_ms: 500}}
devices: {tank: {profile: tank.yaml, bus: lan, unit: 1, poll: {values: {every_ms: 100}}, writable: [valve]}}
plc:
  programs:
    pump:
      source: "python: plc.control:Pump"
      inputs: {level: {tag: tank.level}}
      outputs: {valve: tank.valve}
    alarm:
      source: alarm.st
      inputs: {level: {tag: tank.level}}
"""
ALARM = """PROGRAM alarm
  VAR_INPUT level : REAL; END_VAR
  VAR high : BOOL; END_VAR
  high := level > 200.0;
END_PROGRAM
"""
PROTOTYPE = """prototype_of: shed.yaml
unmapped: refuse
buses: {lan: {listen: "tcp://127.0.0.1:0"}}
devices: {tank: {model: profile, values: {level: 250}}}
"""
SCENARIO = """scenario: the user's own program opens the valve
system: shed.yaml
steps:
  - expect: {that: "tank.valve == 1 and alarm.high", within: 5s}
"""
DRIVER_TEST = """import socket
import gateway_of_mine
import plc.control
import pytest


@pytest.mark.fieldtwin(device="eastron-sdm630", on="tcp", values={"voltage_l1": 230.5})
def test_a_device(device):
    with socket.create_connection((device.host, device.port), timeout=5) as line:
        line.sendall(bytes.fromhex("000100000006") + bytes([device.unit]) + bytes.fromhex("0400000002"))
        assert line.recv(64)[7:9] == bytes.fromhex("0404")


@pytest.mark.fieldtwin(system="../shed.yaml", plc="pump")
def test_the_program(plc):
    assert plc.set(level=250.0).scan()["valve"] == 1
"""


@pytest.fixture
def site(tmp_path: Path) -> Path:
    """The folder in which the user works."""
    for name in ("gateway", "emulators", "twin"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").write_text(NOT_OURS)
    for name in ("plc", "tests"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").write_text("")
    (tmp_path / "plc" / "control.py").write_text(PUMP)
    (tmp_path / "tests" / "test_driver.py").write_text(DRIVER_TEST)
    (tmp_path / "gateway_of_mine.py").write_text("")
    (tmp_path / "tank.yaml").write_text(PROFILE)
    (tmp_path / "alarm.st").write_text(ALARM)
    (tmp_path / "shed.yaml").write_text(SYSTEM)
    (tmp_path / "shed.prototype.yaml").write_text(PROTOTYPE)
    (tmp_path / "valve.scenario.yaml").write_text(SCENARIO)
    return tmp_path


@pytest.fixture(params=["folders", "distribution"])
def environment(request: pytest.FixtureRequest, site: Path) -> dict[str, str]:
    """The user's variables alone, or with a path on which an installed distribution has a module `gateway`."""
    path = [str(CHECKOUT)]
    if request.param == "distribution":
        installed = site / "site-packages"
        (installed / "gateway-1.0.dist-info").mkdir(parents=True)
        (installed / "gateway-1.0.dist-info" / "METADATA").write_text(
            "Metadata-Version: 2.1\nName: gateway\nVersion: 1.0\n"
        )
        (installed / "gateway.py").write_text(NOT_OURS)
        path.insert(0, str(installed))
    return {**os.environ, "PYTHONPATH": os.pathsep.join(path), "FIELDTWIN_RUN": str(site / "r"), "NO_COLOR": "1"}


def did(site: Path, environment: dict[str, str], *words: str) -> subprocess.CompletedProcess[str]:
    """Return the result of `python -m WORDS` in the user's folder; Python puts that folder first on the path."""
    return subprocess.run(
        [sys.executable, "-m", *words],
        cwd=site,
        env=environment,
        capture_output=True,
        text=True,
        timeout=50,
        check=False,
    )


@pytest.mark.long
@pytest.mark.parametrize(
    "words",
    [
        ("run", "shed.yaml", "--prototype", "--for", "2s"),
        ("simulate", "shed.yaml", "--for", "10s"),
        ("test", "valve.scenario.yaml"),
        ("test", "valve.scenario.yaml", "--target", "local"),
        ("with", "shed.yaml", "--", "true"),
    ],
    ids=["run", "virtual", "test", "test local", "with"],
)
def test_a_command_runs(site: Path, environment: dict[str, str], words: tuple[str, ...]) -> None:
    done = did(site, environment, "fieldtwin", *words)
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.long
def test_the_plugin_runs(site: Path, environment: dict[str, str]) -> None:
    plugins = ("-p", "fieldtwin.pytest_plugin", "-p", "no:cacheprovider")
    done = did(site, environment, "pytest", "-q", *plugins, "--timeout=40", "tests")
    assert "2 passed" in done.stdout, done.stdout + done.stderr


def test_a_device_is_emulated(site: Path, environment: dict[str, str]) -> None:
    emulator = subprocess.Popen(
        [sys.executable, "-m", "fieldtwin", "emulate", "tank.yaml", "--on", "tcp://127.0.0.1:0"],
        cwd=site, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True,
    )  # fmt: skip
    assert emulator.stderr is not None
    said = emulator.stderr.readline() + emulator.stderr.readline()  # its values, and where it listens
    os.killpg(emulator.pid, signal.SIGINT)
    _, errors = emulator.communicate(timeout=20)
    assert "tcp://127.0.0.1:" in said, said + errors
    assert "Traceback" not in errors
