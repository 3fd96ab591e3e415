"""Traces for tests: a failing scenario on the observatory, run by the real command, and the state that its lines say."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

TITLE = "the pressure stays good while the ctd is silent"
SCENARIO = f"""scenario: {TITLE}
system: observatory
seed: 7
steps:
  - send: {{period_s: 1}}
  - wait: {{until: "relay.state == 'ACTIVE' and quality(ctd.pressure) == 'good'", within: 15s}}
  - fault: {{id: quiet, name: silence, device: ctd}}
  - pause: 5s
  - expect: {{tag: ctd.pressure, quality: good, within: 1s}}
"""
FAULT_NS, FAILED_NS = 520_000_000, 6_520_000_000
"""The instants of the fault and of the failed check. Virtual time makes them the same in each run."""


def failing_trace(folder: Path, *options: str) -> Path:
    """Run the scenario with ``fieldtwin test --trace``, and return the trace."""
    scenario, trace = folder / "fail.scenario.yaml", folder / "fail.jsonl"
    scenario.write_text(SCENARIO)
    command = [sys.executable, "-m", "fieldtwin", "test", str(scenario), "--trace", str(trace), *options]
    result = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=60, check=False)
    assert result.returncode == 1, result.stdout + result.stderr
    return trace


def lines_of(trace: Path) -> list[tuple[int, str, str, dict[str, Any]]]:
    return [tuple(json.loads(line)) for line in trace.read_text(encoding="utf-8").splitlines()]


def folded(trace: Path, kind: str, t_ns: int) -> dict[str, dict[str, Any]]:
    """Return by name the latest event of a kind up to an instant, but not what the run did after the failed check."""
    found: dict[str, dict[str, Any]] = {}
    for at, word, where, data in lines_of(trace):
        if at > t_ns:
            break
        if word == kind:
            found[where] = data | {"t_ns": at}
        if word == "step" and data.get("verdict") == "failed" and at == t_ns:
            break
    return found
