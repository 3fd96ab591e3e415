"""Tags that are writable and never read back. Defect: `io.outputs_1: 0 bad, 15 s old` was shown without the reason.

The author of the system file is warned when the file is loaded, and a bad value always has its reason.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
from fan_hall import VirtualHall, hall

from fieldtwin.gateway.core.values import Quality, Reason
from fieldtwin.run.targets.virtual_scenario import run_virtual
from fieldtwin.scenarios.language.form import load_scenario
from fieldtwin.testing.worker.stepped_program import SteppedProgram
from fieldtwin.twin.prototype.virtual import VirtualPrototype
from fieldtwin.twin.site.system import load_system

NODE = """
fieldtwin: 1
system: node
buses: {can0: {url: "can:socketcan/can0"}}
devices:
  io:
    profile: io-cia401
    bus: can0
    node: 5
    heartbeat: {producer_ms: 500, consumer_ms: 1500}
    writable: [outputs_1]
    MORE
    start: true
plc: {programs: {idle: {source: idle.st}}}
"""
IDLE = "PROGRAM Idle\nVAR n : INT; END_VAR\nn := n + 1;\nEND_PROGRAM\n"


def node(folder: Path, more: str = "") -> Path:
    (folder / "idle.st").write_text(IDLE)
    (folder / "node.yaml").write_text(NODE.replace("MORE", more or "poll: {}"))
    return folder / "node.yaml"


def test_a_writable_tag_that_is_never_read_back_is_named_with_the_remedy(tmp_path: Path) -> None:
    (warning,) = load_system(str(node(tmp_path))).warnings
    assert "io.outputs_1 may be written but is never read back" in warning
    assert f"{tmp_path}/node.yaml:11:16" in warning
    assert "`values: {every_ms: 1000}` in `poll` of io, or the tag in its `tpdo1`" in warning


@pytest.mark.parametrize(
    "more", ["poll: {values: {every_ms: 500}}", "tpdo1: {map: [outputs_1], event_ms: 500}", "tpdos: node"]
)
def test_a_tag_that_is_read_by_a_poll_or_brought_by_the_node_gives_no_warning(tmp_path: Path, more: str) -> None:
    assert load_system(str(node(tmp_path, more))).warnings == ()


def test_a_register_that_can_only_be_written_gives_no_warning(tmp_path: Path) -> None:
    assert load_system(str(hall(tmp_path, writable="mode, lamp"))).warnings == ()


def test_the_warning_is_shown_when_the_file_is_loaded(tmp_path: Path) -> None:
    system = hall(tmp_path)
    system.write_text(system.read_text().replace("    poll: {status: {every_ms: 500}}\n", ""))
    words = ("simulate", str(system), "--for", "2s", "--json")
    run = subprocess.run(
        [sys.executable, "-m", "fieldtwin", *words], capture_output=True, text=True, timeout=60, check=True
    )
    assert "warning: " in run.stderr
    assert "fan.mode may be written but is never read back" in run.stderr.replace("\n", " ")
    assert json.loads(run.stdout)["warnings"] == list(load_system(str(system)).warnings)


def test_a_value_that_was_read_before_a_write_and_never_after_it_is_not_good(tmp_path: Path) -> None:
    """Defect: it was shown as good forever, with the value from before the write."""
    system = hall(tmp_path, mode=0)
    text = system.read_text().replace("    poll: {status: {every_ms: 500}}\n", "    expect: {speed: '3'}\n")
    system.write_text(text)

    async def look(run: VirtualPrototype) -> None:
        seen = run.gateway.tags.current("fan.mode", run.loop.now_ns)
        assert run.gateway.outputs.writes == 1
        assert (seen.quality, seen.reason) == (Quality.BAD, Reason.STALE)

    VirtualHall(system, tmp_path).run(3, look)


def test_a_scenario_shows_why_a_value_is_bad(tmp_path: Path) -> None:
    hall(tmp_path)
    file = tmp_path / "silent.scenario.yaml"
    file.write_text(
        "scenario: silent sensor\nsystem: hall.yaml\nsteps:\n"
        "  - pause: 5s\n"
        "  - fault: {name: silence, device: sensor}\n"
        "  - pause: 20s\n"
        "  - expect: {that: \"quality(sensor.temperature) == 'good'\", within: 1s}\n"
    )
    result = run_virtual(load_scenario(file, []))
    got = " ".join(check.got for check in result.checks)
    assert "sensor.temperature: " in got
    assert "bad (timeout)" in got or "bad (unreachable)" in got


def test_an_input_that_a_test_makes_bad_has_a_reason(tmp_path: Path) -> None:
    hall(tmp_path)
    program = SteppedProgram("python: hall_fan:Fan", (str(tmp_path),), 10.0)
    program.set("temperature", 20.0, "bad")
    assert program._inputs["temperature"].reason is Reason.TIMEOUT
