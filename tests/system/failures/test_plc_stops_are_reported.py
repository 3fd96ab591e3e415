"""A PLC that stopped by itself during a run makes the run not ok, even if it runs again at the end.

Defect: three stops by the watchdog, each with "PLC LOST" in the live view, and then `ok` with exit code 0.
"""

from __future__ import annotations

import os
import signal
from pathlib import Path

import pytest
from procs import every_device_online, fieldtwin, run_to_end

PROFILE = """device: own/tank
source: "this test"
protocol: modbus
numbering: printed
defaults: {poll: values}
tags: {level: {at: 30001, type: uint16}}
"""
SYSTEM = """fieldtwin: 1
system: shed
buses: {lan: {url: "tcp://tank:502"}}
devices: {tank: {profile: tank.yaml, bus: lan, unit: 1, poll: {values: {every_ms: 100}}}}
plc:
  watchdog: {stuck_ms: 200}
  programs: {once: {source: "python: once:Once", inputs: {level: {tag: tank.level}}}}
"""
PROTOTYPE = """prototype_of: shed.yaml
buses: {lan: {listen: "tcp://127.0.0.1:0"}}
devices: {tank: {model: profile}}
"""
PROGRAM = """from fieldtwin.gateway.core.image.image import TagKind
from fieldtwin.plc.program import Program, ScanInfo, var_input, var_retain


class Once(Program):
    level: int | None = var_input(TagKind.INT)
    starts: int = var_retain(TagKind.INT, initial=0)

    def execute(self, scan: ScanInfo) -> None:
        self.starts += scan.first_scan
        while self.starts == 1 and scan.number > 5:
            pass
"""


@pytest.mark.long
def test_a_run_whose_plc_stopped_and_began_again_is_not_ok(tmp_path: Path) -> None:
    (tmp_path / "tank.yaml").write_text(PROFILE)
    (tmp_path / "shed.yaml").write_text(SYSTEM)
    (tmp_path / "shed.prototype.yaml").write_text(PROTOTYPE)
    (tmp_path / "once.py").write_text(PROGRAM)
    done = run_to_end(tmp_path, "run", str(tmp_path / "shed.yaml"), "--prototype", "--for", "4s")
    assert done.process.returncode == 1, done.out + done.err
    assert "PLC: stopped without a request once, and restarted after that; the last time: program once" in done.out


@pytest.mark.long
def test_a_run_whose_gateway_died_does_not_claim_to_know_its_outputs(tmp_path: Path) -> None:
    with fieldtwin(tmp_path, "run", "observatory", "--prototype", "--for", "6s") as run:
        gateway = run.control("observatory", "gateway")
        every_device_online(gateway)
        os.kill(run.pid_of("observatory", "gateway"), signal.SIGKILL)
        run.wait(30)
    assert run.process.returncode == 1
    assert "its published values and outputs are not known" in run.out
