"""An FMU in its child process: its values are those of its equations, and every failure is an error that names it."""

from __future__ import annotations

import math
import os
import select
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import pytest
from fmu_rig import FAILURES, build_fmu, needs_gcc

from fieldtwin.emulators.simulation.fmu.description import describe
from fieldtwin.emulators.simulation.fmu.process import FmuBinding, FmuProcess
from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.twin.plant.child import command

pytestmark = needs_gcc
OUTPUTS = {"level": "level", "outflow": "outflow", "full": "full"}


def started(path: Path, limit_ms: int = 30_000, **start: float) -> FmuProcess:
    inputs = {"pump": "pump", "inflow": "inflow"}
    return FmuProcess("water", FmuBinding(describe(path), start, inputs, OUTPUTS), limit_ms, command)


def trace(fmu: FmuProcess, steps: int) -> list[dict[str, float]]:
    try:
        return [
            fmu.step(number / 10, min(number, 1) / 10, {"pump": float(number > 5), "inflow": 0.001 * number})
            for number in range(steps)
        ]
    finally:
        fmu.close()


@pytest.mark.parametrize("fmi", [2, 3])
def test_its_values_are_those_of_its_equations_and_the_same_each_time(tmp_path: Path, fmi: int) -> None:
    path = build_fmu(tmp_path / "tank.fmu", fmi)
    found = trace(started(path, level=1.5, area=0.8), 40)
    assert found == trace(started(path, level=1.5, area=0.8), 40)
    assert found[0] == {"level": 1.5, "outflow": 0.03 * math.sqrt(1.5), "full": 0.0}
    level = 1.5
    for number in range(1, 40):
        for _ in range(10):
            level += (0.001 * number + 0.08 * (number > 5) - 0.03 * math.sqrt(level)) / 0.8 * 0.01
        assert found[number]["level"] == pytest.approx(level, abs=1e-9)


def test_both_versions_of_fmi_give_the_same_values(tmp_path: Path) -> None:
    two, three = (trace(started(build_fmu(tmp_path / f"{fmi}.fmu", fmi), level=2.25), 40) for fmi in (2, 3))
    assert two == three
    assert two[-1]["full"] == 1.0


def test_nothing_remains_after_it_is_closed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    fmu = started(build_fmu(tmp_path / "tank.fmu"))
    fmu.step(0.0, 0.0, {})
    process = fmu._process
    assert process is not None
    assert list(tmp_path.glob("fieldtwin-fmu-*"))
    fmu.close()
    assert process.returncode == -signal.SIGKILL
    assert not list(tmp_path.glob("fieldtwin-fmu-*"))
    with pytest.raises(FileInvalid, match="has ended"):
        fmu.step(0.1, 0.1, {"pump": 0.0, "inflow": 0.0})


MESSAGES = {
    "crash": r"its process has ended during the step to 0\.7 s: SIGSEGV, a crash of its code",
    "endless": r"the step to 0\.7 s took more than 200 ms of real time, and its process was killed",
    "discard": r"the step to 0\.7 s failed: fmi\dDoStep failed with status 2 \(discard\)",
    "error": r"the step to 0\.7 s failed: fmi\dDoStep failed with status 3 \(error\)",
    "fatal": r"the step to 0\.7 s failed: fmi\dDoStep failed with status 4 \(fatal\)",
    "not a number": r"the output 'outflow' is nan at 0\.7 s",
    "exit": r"its process has ended during the step to 0\.7 s: exit code 3",
    "abort": r"its process has ended during the step to 0\.7 s: SIGABRT, a crash of its code",
}


@pytest.mark.parametrize("fmi", [2, 3])
@pytest.mark.parametrize("fails", FAILURES)
def test_every_failure_of_a_step_is_an_error_that_names_fmu_and_time(tmp_path: Path, fails: str, fmi: int) -> None:
    fmu = started(build_fmu(tmp_path / "tank.fmu", fmi, fails))
    for number in range(7):
        fmu.step(number / 10, min(number, 1) / 10, {"pump": 1.0, "inflow": 0.0})
    if fails == "endless":
        fmu._limit_ms = 200  # not before, because a busy computer may need longer for a good step
    for _ in range(2):  # it stays failed: no later step gives a value
        with pytest.raises(
            FileInvalid, match=r"tank\.fmu: the FMU of the simulation 'water' failed: " + MESSAGES[fails]
        ):
            fmu.step(0.7, 0.1, {"pump": 1.0, "inflow": 0.0})
    process = fmu._process
    assert process is not None
    assert process.returncode is not None


def test_an_input_that_is_not_a_number_does_not_reach_the_fmu(tmp_path: Path) -> None:
    fmu = started(build_fmu(tmp_path / "tank.fmu"))
    fmu.step(0.0, 0.0, {})
    with pytest.raises(FileInvalid, match=r"the input 'inflow' is nan at 0\.1 s"):
        fmu.step(0.1, 0.1, {"pump": 1.0, "inflow": math.nan})


def test_a_wrong_token_is_a_failed_initialization(tmp_path: Path) -> None:
    path = build_fmu(tmp_path / "tank.fmu")
    fmu = describe(path)
    binding = FmuBinding(type(fmu)(path, 2, fmu.identifier, "other", None, fmu.variables), {}, {}, OUTPUTS)
    with pytest.raises(FileInvalid, match="the initialization failed: Failed to instantiate"):
        FmuProcess("water", binding, 30_000, command).step(0.0, 0.0, {})


PARENT = """
import sys
from pathlib import Path
from test_fmu_process import started
fmu = started(Path(sys.argv[1]), 600_000)
fmu.step(0.0, 0.0, {})
fmu.step(0.6, 0.6, {"pump": 0.0, "inflow": 0.0})
print(fmu._process.pid, flush=True)
fmu.step(0.7, 0.1, {"pump": 0.0, "inflow": 0.0})
"""


def ticks(process: int) -> int:
    """Return the processor time that a process has used in its own code (proc(5), utime)."""
    return int(Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[11])


def test_it_ends_with_its_parent_in_the_middle_of_an_endless_step(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = build_fmu(tmp_path / "tank.fmu", fails="endless")
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "TMPDIR": str(tmp_path)}
    parent = subprocess.Popen(
        [sys.executable, "-c", PARENT, str(path)], stdout=subprocess.PIPE, text=True, env=environment
    )
    with parent:
        assert parent.stdout is not None
        child = int(parent.stdout.readline())
        ended = os.pidfd_open(child)
        before = ticks(child)
        while ticks(child) < before + 5:  # until it is in the endless step, and would not notice a closed pipe
            time.sleep(0.01)
        parent.kill()
    try:
        assert select.select([ended], [], [], 30)[0], "the process of the FMU outlived its parent"
    finally:
        with suppress(ProcessLookupError):
            signal.pidfd_send_signal(ended, signal.SIGKILL)
        os.close(ended)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    [left] = tmp_path.glob("fieldtwin-fmu-*")
    running, next_one = started(path), started(path)
    running.step(0.0, 0.0, {})
    assert not left.exists(), "the folder of the killed process is removed"
    [of_running] = tmp_path.glob("fieldtwin-fmu-*")
    next_one.step(0.0, 0.0, {})
    assert of_running.exists(), "the folder of a running process is not removed"
    running.close()
    next_one.close()
    assert not list(tmp_path.glob("fieldtwin-fmu-*"))
