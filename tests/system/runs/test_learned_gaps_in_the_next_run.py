"""A prototype on a line that echoes: facts learned about its device in one run are used in the next, and listed at the end."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from procs import run_to_end

FILES = {
    "meter.yaml": """
device: mysite/meter
source: "a test"
protocol: modbus
timing: {spacing_ms: 5}
tags:
  a: {at: "holding:0", type: float32}
  b: {at: "holding:5", type: float32}
""",
    "echoing.yaml": """
fieldtwin: 1
system: echoing
buses:
  line1: {url: "rtu:/dev/ttyS0?baudrate=19200&frame=8E1", echo: true, strict: true}
devices:
  meter: {profile: ./meter.yaml, bus: line1, unit: 1, poll: {values: {every_ms: 200, phase_ms: 50}}}
plc:
  programs: {watch: {source: "python: watcher:Watch", inputs: {a: {tag: meter.a}}}}
""",
    "echoing.prototype.yaml": """
prototype_of: echoing.yaml
buses: {line1: {listen: "pty:line1"}}
devices: {meter: {recording: ./meter.jsonl, at_end: loop}}
""",
    "meter.jsonl": """{"fieldtwin_recording":1,"device":"mysite/meter","kind":"exchanges","source":"synthetic"}
{"t":0.0,"unit":1,"req":"0300000002","rep":"03043f800000","lat":0.004}
{"t":0.1,"unit":1,"req":"0300050002","rep":"030440000000","lat":0.004}
{"t":0.3,"unit":1,"req":"0300000007","rep":"8302","lat":0.004}
""",
    "watcher.py": """
from fieldtwin.gateway.core.image.image import TagKind
from fieldtwin.plc.program import Program, ScanInfo, var_input


class Watch(Program):
    a: float | None = var_input(TagKind.REAL)

    def execute(self, scan: ScanInfo) -> None:
        pass
""",
}


@pytest.mark.long
def test_facts_learned_in_one_run_are_known_in_the_next(tmp_path: Path) -> None:
    for name, text in FILES.items():
        (tmp_path / name).write_text(text.lstrip(), encoding="utf-8")
    written: list[int] = []
    for turn in ("first", "second"):
        wanted = ("run", str(tmp_path / "echoing.yaml"), "--prototype", "--for", "2s", "--instance", "le", "--json")
        run = run_to_end(tmp_path, *wanted, name=turn)
        assert run.process.returncode == 0, run.err
        assert run.summary["errors"] == []
        assert run.summary["learnt"]["meter"]["line"] == 'gaps: ["holding:2..4"]'
        assert run.summary["published"]["wrong"] == 0
        exchanged = run.summary["exchanges"]["line1"]
        assert exchanged["gateway"]["replies"] == exchanged["emulators"]["replies"] > 10
        (kept,) = tmp_path.rglob("learnt.prototype.json")
        written.append(kept.stat().st_mtime_ns)
    assert json.loads(kept.read_text())["meter"]["gaps"] == ["holding:2..4"]
    assert written[0] == written[1]  # the second run learned nothing
