"""A scenario process that gets no CPU time measures that, and subtracts it from a deadline: real processes, the scenario's is
stopped.

The system under test is not late in these tests, so exactly the measured lateness is subtracted.
"""

from __future__ import annotations

import json
import signal
import time
from pathlib import Path
from typing import Any

import pytest
from procs import Asking, fieldtwin, free_port, no_tracebacks, wait_for
from shed_site import write_shed

pytestmark = pytest.mark.long

WITHIN_S = 4
SCENARIO = f"""scenario: the level rises
system: shed.yaml
probes:
  device: {{endpoint: "${{FIELDTWIN_LAN_URL}}", every: 50ms, registers: {{level: {{at: 30001}}}}}}
steps:
  - expect: {{that: "device.level == 77", within: {WITHIN_S}s}}
"""


@pytest.mark.parametrize("stopped", [True, False])
def test_the_lateness_of_the_judge_is_subtracted_and_that_of_the_system_is_not(tmp_path: Path, stopped: bool) -> None:
    """The level rises after the deadline. If the scenario process was stopped for that time, it cannot know that, and passes;
    if it ran all the time, the same rise fails."""
    write_shed(tmp_path)
    (tmp_path / "a.scenario.yaml").write_text(SCENARIO)
    port = free_port()
    emulate = ("emulate", str(tmp_path / "shed.yaml"), "--control", f"127.0.0.1:{port}")
    words = ("test", str(tmp_path / "a.scenario.yaml"), "--target", "compose", "--field", f"127.0.0.1:{port}", "--json")
    with fieldtwin(tmp_path, *emulate, name="field") as side:
        wait_for(lambda: "now: fieldtwin run" in side.err, 30, "the field simulator is up")
        field = Asking(("127.0.0.1", port))
        with fieldtwin(tmp_path, *words, name="judge") as judge:
            wait_for(lambda: field("get")["devices"]["tank"]["counters"]["requests"] > 5, 30, "the judge looks")
            begun_s = time.monotonic()
            if stopped:
                judge.signal(signal.SIGSTOP)
            wait_for(lambda: time.monotonic() > begun_s + WITHIN_S + 1, 30, "the deadline is over")
            field("set", device="tank", tag="level", value=77)
            if stopped:
                judge.signal(signal.SIGCONT)
            judge.wait(60)
        (result,) = json.loads(judge.out)
    check: dict[str, Any] = result["checks"][0]
    if stopped:
        assert (result["verdict"], judge.process.returncode) == ("passed", 0), check
        assert "which was subtracted" in check["reason"]
    else:
        assert result["verdict"] == "failed", check
    no_tracebacks(tmp_path)
