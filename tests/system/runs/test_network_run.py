"""A network as processes on this host: nine processes, three ptys, and the acoustic channel on a socket between them."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from procs import no_tracebacks, run_to_end

pytestmark = [pytest.mark.long, pytest.mark.timeout(300)]

RELAYED = """
scenario: what the ship says reaches the eastern observatory over the two others
system: ocean_network
seed: 5
always: ["west.adapt.missed == 0 and middle.adapt.missed == 0 and east.adapt.missed == 0"]
steps:
  - send: {period_s: 3}
  - wait: {until: "west.adapt.state == 'ACTIVE'", within: 40s}
  - fault: {id: gone, name: silence, device: middle.optode}
  - wait: {until: "east.adapt.state == 'ACTIVE'", within: 90s}
  - expect: {that: "east.adapt.hops == 2 and middle.adapt.hops == 1"}
  - expect: {tag: middle.optode.status, quality: bad, within: 40s}
  - clear: gone
  - expect: {tag: east.current.speed, quality: good, within: 15s}
  - expect: {wire: east.current, requests_per_s: {max: 4}, during: 3s}
"""


def test_a_scenario_of_a_network_runs_unchanged_as_processes(tmp_path: Path) -> None:
    path = tmp_path / "n.scenario.yaml"
    path.write_text(RELAYED)
    ended = run_to_end(tmp_path, "test", str(path), "--target", "local", "--json", within_s=240)
    result = json.loads(ended.out)[0]
    late = any("late by itself" in check["got"] for check in result["checks"])
    assert (result["verdict"], ended.process.returncode) == (("inconclusive", 1) if late else ("passed", 0)), result
    assert not list(tmp_path.glob("test-*")), "the run directories are gone"
    no_tracebacks(tmp_path)


def test_a_run_of_a_network_reports_the_result_of_each_system(tmp_path: Path) -> None:
    """Also of faults: one system has a fault for a while, and the acoustic channel at the western receiver."""
    (tmp_path / "f.yaml").write_text(
        "faults:\n  - {name: silence, device: east.current, from: 0, until: 2}\n  - {name: drop, bus: water, device: west}\n"
    )
    words = (
        "run",
        "ocean_network",
        "--prototype",
        "--for",
        "9s",
        "--commands",
        "none",
        "--json",
        "--thread",
        "tcp://127.0.0.1:0",
        "--faults",
        str(tmp_path / "f.yaml"),
    )
    ended = run_to_end(tmp_path, *words, within_s=180)
    summary = json.loads(ended.out)
    assert (ended.process.returncode, summary["ok"]) == (0, True), summary["systems"]
    assert "west (ocean_west): hears middle, ship" in ended.err
    for one in summary["systems"].values():
        assert one["states"] == {"adapt": ["STANDBY"]}
        assert {d["state"] for d in one["devices"].values()} == {"good"}
        assert one["outputs_safe"]
        assert one["thread"]["written"] > 0
    assert ended.err.count("digital thread  ←  tcp://127.0.0.1:") == 3
    assert {name for name, sea in summary["water"].items() if sea["said"]} == {"west", "middle", "east"}
    struck = {name for name, one in summary["systems"].items() if one["exchanges"]["line"]["timeouts"]}
    assert "east" in struck
    assert {name for name, sea in summary["water"].items() if sea["fault"]} == {"west"}
    no_tracebacks(tmp_path)
