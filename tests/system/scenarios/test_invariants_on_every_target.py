"""Invariants of the system file are checked on the targets compose and real, and in networks on local; with the user's own
controller they are skipped, which the output states."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from procs import every_device_online, fieldtwin, free_port, no_tracebacks, run_to_end, wait_for
from well_site import write_program, write_site

pytestmark = [pytest.mark.long, pytest.mark.timeout(300)]
SYSTEMS = Path(__file__).resolve().parents[3] / "profiles" / "systems"
PROBED = """scenario: the well, with a controller of the user
system: shed.yaml
probes:
  device: {endpoint: "${FIELDTWIN_LAN_URL}", every: 50ms, registers: {level: {at: 40001}}}
steps:
  - expect: {that: "device.level == 42", within: 60s}
"""
HOLDS = pytest.mark.parametrize(("limit", "verdict"), [("10", "failed"), ("50", "passed")])


@pytest.fixture
def site(tmp_path: Path) -> Iterator[Path]:
    write_site(tmp_path, "shed", f"tcp://127.0.0.1:{free_port()}")
    (tmp_path / "probed.scenario.yaml").write_text(PROBED)
    yield tmp_path
    no_tracebacks(tmp_path)


def judged(site: Path, *words: str) -> dict[str, Any]:
    ended = run_to_end(site, "test", *words, name="test", within_s=150)
    assert ended.out, ended.err
    (result,) = json.loads(ended.out)
    assert ended.process.returncode == (0 if result["verdict"] == "passed" else 1)
    found: dict[str, Any] = result
    return found


def check(result: dict[str, Any], verdict: str) -> None:
    assert result["verdict"] == verdict, result
    if verdict == "failed":
        assert result["reason"].startswith("invariant never 1: ")
    else:
        numbers = {one["number"]: one["verdict"] for one in result["checks"]}
        assert (numbers["invariant always 1"], numbers["invariant never 1"]) == ("passed", "passed")


@HOLDS
def test_a_running_system_is_checked_by_its_invariants(site: Path, limit: str, verdict: str) -> None:
    write_program(site, limit)
    with fieldtwin(site, "run", str(site / "shed.yaml"), "--prototype") as running:
        every_device_online(running.control("shed", "gateway"))
        check(judged(site, str(site / "well.scenario.yaml"), "--target", "compose", "--json"), verdict)


@HOLDS
def test_a_plant_is_checked_by_its_invariants(site: Path, limit: str, verdict: str) -> None:
    write_program(site, limit)
    port = (site / "shed.yaml").read_text().split("127.0.0.1:")[1].split('"')[0]
    words = ("emulate", str(site / "well.yaml"), "--values", "level=42", "--on", f"tcp://127.0.0.1:{port}")
    with fieldtwin(site, *words, name="field") as field:
        wait_for(lambda: port in field.err + field.out, 20, "the sensor is up")
        check(judged(site, str(site / "well.scenario.yaml"), "--target", "real", "--json"), verdict)


def test_with_a_users_controller_they_are_skipped_with_a_message(site: Path) -> None:
    write_program(site, "10")
    words = (str(site / "probed.scenario.yaml"), "--json", "--with", "--", "sleep", "600")
    result = judged(site, *words)
    assert result["verdict"] == "passed", result
    (skipped,) = [one for one in result["checks"] if one["number"] == "invariants"]
    assert skipped["verdict"] == "skipped"
    assert "not checked: a third-party controller" in skipped["got"]
    shown = run_to_end(site, "test", *(word for word in words if word != "--json"), name="shown", within_s=150)
    assert "invariants skipped: not checked: a third-party controller" in shown.out


def test_a_network_on_this_host_is_checked_by_the_invariants_of_its_members(tmp_path: Path) -> None:
    for path in (*SYSTEMS.glob("ocean*.yaml"), SYSTEMS / "adapt.st"):
        if not path.name.endswith(".scenario.yaml"):
            shutil.copy(path, tmp_path)
    for member, text in (("west", '["adapt.missed == 0"]'), ("middle", "[\"adapt.state != 'ACTIVE'\"]")):
        file = tmp_path / f"ocean_{member}.yaml"
        file.write_text(f"{file.read_text()}\ninvariants:\n  always: {text}\n")
    (tmp_path / "active.scenario.yaml").write_text(
        "scenario: every observatory goes to work\nsystem: ocean_network.yaml\nseed: 2\nsteps:\n"
        "  - send: {from: ship, period_s: 10}\n"
        "  - wait: {until: \"east.adapt.state == 'ACTIVE' and middle.adapt.state == 'ACTIVE'\", within: 90s}\n"
    )
    result = judged(tmp_path, str(tmp_path / "active.scenario.yaml"), "--target", "local", "--json")
    assert result["verdict"] in ("failed", "inconclusive"), result
    assert result["reason"].startswith("middle.invariant always 1: ")
    no_tracebacks(tmp_path)
