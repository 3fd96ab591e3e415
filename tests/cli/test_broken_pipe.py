"""A reader that closes its pipe: diagnostics do not end the run, a verdict remains the same, and a listing ends."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

CHECKOUT = Path(__file__).resolve().parents[2]
SCENARIO = """scenario: deeper than the sea
system: observatory
steps:
  - expect: {that: "ctd.pressure > 20000", within: 1s}
"""


def ended(folder: Path, *args: str, unread: str) -> subprocess.CompletedProcess[str]:
    """Run `fieldtwin ARGS`, whose reader of stdout or stderr has closed the pipe before any output."""
    (folder / "x.scenario.yaml").write_text(SCENARIO)
    reading, writing = os.pipe()
    os.close(reading)
    to: dict[str, int] = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, unread: writing}
    try:
        return subprocess.run(
            [sys.executable, "-W", "error::ResourceWarning", "-m", "fieldtwin", *args], stdin=subprocess.DEVNULL,
            env={**os.environ, "PYTHONPATH": str(CHECKOUT), "FIELDTWIN_RUN": str(folder)}, cwd=folder, text=True,
            check=False, timeout=60, **to,  # type: ignore[call-overload]
        )  # fmt: skip
    finally:
        os.close(writing)


@pytest.mark.long
@pytest.mark.parametrize("unread", ["stdout", "stderr"])
def test_a_verdict_is_the_same_with_any_reader(tmp_path: Path, unread: str) -> None:
    done = ended(tmp_path, "test", "x.scenario.yaml", unread=unread)
    assert done.returncode == 1, done
    assert ("1 failed\n" in (done.stdout or "")) is (unread == "stderr")
    assert all(line.startswith("all events: ") for line in (done.stderr or "").splitlines()), done.stderr


def test_a_listing_ends_when_its_reader_closes_the_pipe(tmp_path: Path) -> None:
    done = ended(tmp_path, "faults", unread="stdout")
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize(
    ("args", "code"), [(("run", "nowhere", "--prototype"), 2), (("rnu",), 2), (("doctr", "-x"), 2)]
)
def test_an_error_into_a_broken_pipe_keeps_its_code(tmp_path: Path, args: tuple[str, ...], code: int) -> None:
    done = ended(tmp_path, *args, unread="stderr")
    assert (done.returncode, done.stdout) == (code, "")
