"""A prototype file may set a bus to `plant`: its devices are real, and without --allow-writes nothing is written to them.

Defect: such a run wrote the program's outputs into the real devices, although only --allow-writes may do that.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest
from procs import fieldtwin, free_port, run_to_end, wait_for

from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.run.live.options import RunOptions
from fieldtwin.run.live.session import RunSession

SYSTEM = """\
fieldtwin: 1
system: site
buses:
  real: {url: "tcp://127.0.0.1:PORT", timeout_ms: 500}
  simulated: {url: "tcp://192.0.2.1:502", timeout_ms: 500}
devices:
  a: {profile: ./lamp.yaml, bus: real, unit: 1, poll: {values: {every_ms: 100}}, writable: [brightness]}
  b: {profile: ./lamp.yaml, bus: simulated, unit: 1, poll: {values: {every_ms: 100}}, writable: [brightness]}
plc:
  cycle_ms: 50
  watchdog: {late_ms: 1000, stop_after: 50}
  programs: {on: {source: on.st, outputs: {one: a.brightness, two: b.brightness}}}
"""
FILES = {
    "lamp.yaml": "device: test/lamp\nsource: none\nprotocol: modbus\ntags: {brightness: {at: 40001, access: rw}}\n",
    "on.st": "PROGRAM On\nVAR_OUTPUT\n  one : UINT;\n  two : UINT;\nEND_VAR\n  one := 7;\n  two := 7;\nEND_PROGRAM\n",
    "site.prototype.yaml": """\
prototype_of: site.yaml
buses: {real: plant, simulated: {listen: "tcp://127.0.0.1:0"}}
devices: {b: {model: profile}}
""",
}

REAL_MODEM = """\
prototype_of: observatory.yaml
buses:
  line1: {listen: "pty:line1"}
  can0: {listen: "can:fieldtwin/127.0.0.1:0"}
  lan: plant
devices:
  ctd: {recording: cast.jsonl, identity: {serial: "0042"}}
  inclinometer: {recording: incl.jsonl, identity: {serial: "1005"}}
"""


@pytest.fixture
def lamp(tmp_path: Path) -> Iterator[str]:
    """The endpoint of the real lamp, which is another process; the site is in `tmp_path`."""
    port = free_port()
    for name, text in {**FILES, "site.yaml": SYSTEM.replace("PORT", str(port))}.items():
        (tmp_path / name).write_text(text, encoding="utf-8")
    endpoint, profile = f"tcp://127.0.0.1:{port}", str(tmp_path / "lamp.yaml")
    with fieldtwin(tmp_path / "lamp", "emulate", profile, "--on", endpoint, name="lamp") as device:
        wait_for(lambda: f":{port}" in device.err + device.out, 30, "the lamp listens")
        yield endpoint


def held(endpoint: str, folder: Path) -> object:
    ended = run_to_end(
        folder / "read", "read", endpoint, "--unit", "1", "--profile", str(folder / "lamp.yaml"), "--json"
    )
    (value,) = json.loads(ended.out)["values"]
    return value["value"]


def outputs_of(folder: Path, *options: str) -> tuple[dict[str, object], str]:
    """Run the site, and return the last values of its tags and the console's output."""
    run = run_to_end(
        folder / "r", "run", str(folder / "site.yaml"), "--prototype", "--for", "3s", "--json", *options, within_s=100
    )
    return json.loads(run.out), run.err


@pytest.mark.long
def test_real_device_of_a_prototype_is_not_written_to_without_allow_writes(lamp: str, tmp_path: Path) -> None:
    summary, told = outputs_of(tmp_path)
    assert held(lamp, tmp_path) == 0
    assert "a.brightness" in json.dumps(summary["refused"])
    assert "b.brightness" not in json.dumps(summary["refused"])
    assert f"{lamp}  (the plant's endpoint, read-only without --allow-writes)" in told


@pytest.mark.long
def test_real_device_of_a_prototype_is_written_to_with_allow_writes(lamp: str, tmp_path: Path) -> None:
    outputs_of(tmp_path, "--allow-writes")
    assert held(lamp, tmp_path) == 7


def test_allow_writes_is_refused_for_a_prototype_without_a_real_bus() -> None:
    with pytest.raises(
        UsageError, match="--allow-writes needs --plant, or a bus that the prototype file sets to `plant`"
    ):
        RunSession(RunOptions("observatory", prototype=True, allow_writes=True))


def test_thread_over_the_modem_of_a_real_bus_needs_allow_writes(tmp_path: Path) -> None:
    path = tmp_path / "observatory.prototype.yaml"
    path.write_text(REAL_MODEM, encoding="utf-8")
    with pytest.raises(UsageError, match="its bus to `plant`; expected --allow-writes"):
        RunSession(RunOptions("observatory", prototype=True, prototype_file=path, thread="modem:"))
