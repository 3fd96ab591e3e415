"""Ctrl-C, as a terminal sends it: to the whole process group. One line at most, no process continues, no traceback."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from support import eventually, run

ROOT = Path(__file__).parents[3]
PROBE = r"""
import os
from fieldtwin.run.processes.workers import Workers
from slow import work

if __name__ == "__main__":
    with Workers(2) as pool:
        waiting = [pool.submit(work, 600) for _ in range(3)]
        os.write(1, b"begun\n")
        for future in waiting:
            future.result()
"""


def _started(command: list[str], cwd: Path, runs: str = "") -> subprocess.Popen[str]:
    return subprocess.Popen(
        command,
        cwd=cwd,
        env={
            **os.environ,
            "PYTHONPATH": f"{ROOT}",
            "TMPDIR": str(cwd),
            **({"FIELDTWIN_RUN": str(cwd / runs)} if runs else {}),
        },
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    )


def _interrupted(process: subprocess.Popen[str], number: int = signal.SIGINT) -> str:
    """Return the output from then on; it ends when the last process with this output has ended."""
    os.killpg(process.pid, number)
    said, _ = process.communicate(timeout=30)
    return said


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_virtual_run_ends_without_a_traceback(tmp_path: Path, number: int, code: int) -> None:
    trace = tmp_path / "run.jsonl"
    options = ["--for", "24h", "--trace", str(trace)]
    process = _started([sys.executable, "-m", "fieldtwin", "simulate", "observatory", *options], tmp_path)

    async def until_it_runs() -> None:
        await eventually(lambda: trace.exists() and trace.stat().st_size > 100_000, within_s=30)

    run(until_it_runs(), timeout_s=40)
    said = _interrupted(process, number)
    assert process.returncode == code
    assert "Traceback" not in said
    assert "Exception ignored" not in said
    assert sorted(left.name for left in tmp_path.iterdir()) == ["run.jsonl", "run.jsonl.about.json"]


@pytest.mark.parametrize("when", ["while they import", "while they work"])
def test_workers_end_with_their_parent(tmp_path: Path, when: str) -> None:
    if when == "while they work":
        text = "import os, time\ndef work(s):\n    os.write(1, b'here\\n')\n    time.sleep(s)\n"
    else:  # first our process, then the group
        text = "import os, time\nos.write(1, b'here\\n')\ntime.sleep(0.3)\nwork = time.sleep\n"
    (tmp_path / "slow.py").write_text(text)
    (tmp_path / "probe.py").write_text(PROBE)
    process = _started([sys.executable, "probe.py"], tmp_path)
    assert process.stdout is not None
    awaited = ["begun", "here"] if when == "while they work" else ["begun", "here", "here"]
    while awaited:
        line = process.stdout.readline().strip()
        assert line
        if line in awaited:
            awaited.remove(line)
    said = _interrupted(process)
    assert process.returncode == -signal.SIGINT
    assert said.count("Traceback") == 1, said  # from the probe itself, which does not catch it


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_run_that_still_starts_ends_at_once(tmp_path: Path, number: signal.Signals) -> None:
    process = _started(
        [sys.executable, "-m", "fieldtwin", "run", "observatory", "--prototype", "--instance", "early"], tmp_path, "r"
    )

    children = Path(f"/proc/{process.pid}/task/{process.pid}/children")

    def has_a_child_of_its_own() -> bool:
        return any(os.getpgid(int(pid)) == int(pid) for pid in children.read_text().split())

    async def until_it_starts_another() -> None:
        await eventually(has_a_child_of_its_own, within_s=30)

    run(until_it_starts_another(), timeout_s=40)
    said = _interrupted(process, number)
    assert process.returncode == 130
    assert said == ""
    assert not list((tmp_path / "r" / "early").glob("*.sock"))
