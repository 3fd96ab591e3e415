"""A third-party controller of the simulated field devices: a libmodbus client, compiled here, checked by probes alone."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest
from procs import CHECKOUT, fieldtwin, free_port, no_tracebacks, run_to_end, wait_for

from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.results.trace import Trace
from fieldtwin.run.benches.control_bench import ControlBench, Where
from fieldtwin.twin.site.system import load_system

HERE = CHECKOUT / "examples" / "own-plc"
MODBUS_H = Path("/usr/include/modbus/modbus.h")


def compiled(source: str, to: Path) -> Path:
    if shutil.which("cc") is None or not MODBUS_H.exists():
        pytest.skip("no C compiler with libmodbus here (build-essential, libmodbus-dev)")
    to.with_suffix(".c").write_text(source, encoding="utf-8")
    flags = ["-Wall", "-Wextra", "-Werror", f"-I{MODBUS_H.parent}"]
    subprocess.run(["cc", *flags, "-o", str(to), str(to.with_suffix(".c")), "-lmodbus"], check=True)
    return to


def judged(tmp_path: Path, source: str) -> dict[str, Any]:
    """Return the scenario's verdict on the controller compiled from `source`."""
    loop = compiled(source, tmp_path / "loop")
    shutil.copytree(HERE, tmp_path / "site")
    field_port, own_port, control = free_port(), free_port(), free_port()
    scenario = tmp_path / "site" / "mooring.scenario.yaml"
    text = scenario.read_text(encoding="utf-8").replace("controller:5020", f"127.0.0.1:{own_port}")
    scenario.write_text(text.replace("field:1502", f"127.0.0.1:{field_port}"), encoding="utf-8")
    listen = f"lan=tcp://127.0.0.1:{field_port}"
    words = (
        "emulate",
        str(tmp_path / "site" / "mooring.yaml"),
        "--listen",
        listen,
        "--control",
        f"127.0.0.1:{control}",
    )
    with fieldtwin(tmp_path, *words, name="field") as field:
        wait_for(lambda: str(field_port) in field.out + field.err, 20, "the field simulator is up")
        controller = subprocess.Popen([loop, "127.0.0.1", str(field_port), str(own_port)])
        try:
            test = ("test", str(scenario), "--target", "compose", "--field", f"127.0.0.1:{control}", "--json")
            ended = run_to_end(tmp_path, *test, within_s=120)
        finally:
            controller.terminate()
            controller.wait()
    no_tracebacks(tmp_path)
    (result,) = json.loads(ended.out)
    return dict(result)


@pytest.mark.long
def test_a_libmodbus_client_behaves_like_our_program(tmp_path: Path) -> None:
    result = judged(tmp_path, (HERE / "loop.c").read_text(encoding="utf-8"))
    assert result["verdict"] in ("passed", "inconclusive"), result
    assert result["verdict"] == "passed" or "late by itself" in str(result["checks"])


@pytest.mark.long
def test_a_controller_with_a_different_decision_fails(tmp_path: Path) -> None:
    wrong = (HERE / "loop.c").read_text(encoding="utf-8").replace("dbar > 50.0f", "dbar > 500.0f")
    result = judged(tmp_path, wrong)
    assert result["verdict"] in ("failed", "inconclusive")
    assert "sensor.period" in str(result["checks"][-1])


def test_a_check_of_our_own_controller_needs_one(tmp_path: Path) -> None:
    scenario = tmp_path / "a.scenario.yaml"
    scenario.write_text(
        "scenario: ours\nsystem: observatory\nsteps:\n  - expect: {tag: ctd.pressure, quality: good, within: 1s}\n"
    )
    ended = run_to_end(tmp_path, "test", str(scenario), "--target", "compose", "--field", "127.0.0.1:1")
    assert ended.process.returncode == 1
    assert "gateway.sock" in ended.out


def test_the_scan_lateness_of_a_foreign_controller_is_not_claimed(tmp_path: Path) -> None:
    bench = ControlBench(load_system("observatory"), Where(tmp_path), Trace(), target="compose", names=[])
    with pytest.raises(UsageError, match="third-party controller"):
        bench.late_ms()


def test_the_foreign_controller_s_text_is_our_program_s() -> None:
    """sampling.st has the same numbers as loop.c and the scenario."""
    text = (HERE / "sampling.st").read_text(encoding="utf-8")
    for value in re.findall(r"pressure [<>] (\d+)\.0", text):
        assert f"{value}.0f" in (HERE / "loop.c").read_text(encoding="utf-8")
