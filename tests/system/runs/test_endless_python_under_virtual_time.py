"""Logic in Python that never ends its scan, in a virtual run of the command line: the run ends and names file and line."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest


@pytest.mark.long
def test_a_virtual_run_ends_and_names_file_and_line(tmp_path: Path) -> None:
    """Defect: only a signal ended it."""
    code = (
        "import sys; sys.path[:0] = ['tests/scenarios/judging', 'tests/unit', 'tests'];"
        "from pathlib import Path; import test_stopped_programs_fail as t;"
        "r = t.run(t.plant(Path(sys.argv[1]), t.PYTHON.replace('raise ValueError(\"no such pump\")', "
        "'n = 0\\n        while True:\\n            n += 1'), t.NO_FAULT));"
        "print(r.verdict.value, r.reason)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path)],
        capture_output=True, text=True, timeout=60, cwd=Path(__file__).parents[3], check=False,
    )  # fmt: skip
    assert done.stdout.startswith("failed"), done.stdout + done.stderr
    assert "the scan did not end" in done.stdout
    assert "pump_" in done.stdout
