"""Two `fieldtwin emulate` processes with one node ID on a software bus: each prints that the other one exists.

Defect: both answered every request, and neither printed anything; only an EMCY on the bus (8150h) showed the collision.
"""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest
from support import eventually, run


@contextmanager
def _emulated(log: Path, what: str, bus: str) -> Iterator[None]:
    argv = [sys.executable, "-m", "fieldtwin", "emulate", what, "--node", "5", "--on", f"can:fieldtwin/{bus}"]
    with log.open("w") as out, subprocess.Popen(argv, stdout=out, stderr=out) as process:
        try:
            yield
        finally:
            process.terminate()
            assert process.wait(30) == 0, log.read_text()


@pytest.mark.long
@pytest.mark.parametrize("second", ["drive-cia402", "profiles/devices/io-cia401.eds"])
def test_each_process_reports_the_other_once(tmp_path: Path, second: str) -> None:
    logs = [tmp_path / "first.log", tmp_path / "second.log"]
    with ExitStack() as stack:
        stack.enter_context(_emulated(logs[0], "io-cia401", "127.0.0.1:0"))
        run(eventually(lambda: "a new bus" in logs[0].read_text(), within_s=60), timeout_s=70)
        bus = re.search(r"can:fieldtwin/(127\.0\.0\.1:\d+)", logs[0].read_text())
        assert bus is not None
        stack.enter_context(_emulated(logs[1], second, bus[1]))
        said = "node 5: another node on the bus has this node ID: it sent"
        run(eventually(lambda: all(said in log.read_text() for log in logs), within_s=60), timeout_s=70)
    for log in logs:
        assert log.read_text().count(said) == 1
        assert "Traceback" not in log.read_text()
