"""A full disk, a missing folder and a closed pipe give one line that names the place, never an internal error."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from click.testing import CliRunner

from fieldtwin.cli.main import cli
from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.results.trace import open_sink

ROOT = Path(__file__).parents[2]


def _run(*words: str, to: str | None = None) -> tuple[int, str]:
    with open(to or os.devnull, "wb") as out:
        ended = subprocess.run(
            [sys.executable, "-m", "fieldtwin", *words],
            stdin=subprocess.DEVNULL,
            stdout=out,
            stderr=subprocess.PIPE,
            text=True,
            check=False,
            env={**os.environ, "PYTHONPATH": str(ROOT)},
        )
    return ended.returncode, ended.stderr


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="this system has no /dev/full")
def test_a_full_disk_is_not_our_bug() -> None:
    code, said = _run("schema", "system", to="/dev/full")
    assert code == 3
    assert said == "fieldtwin: a file or the output: No space left on device\n"


def test_a_trace_that_cannot_be_written(tmp_path: Path) -> None:
    with pytest.raises(FileInvalid, match=r"nowhere/run.jsonl: cannot write the trace: No such file"):
        open_sink(tmp_path / "nowhere" / "run.jsonl")


def test_a_command_that_was_nearly_meant() -> None:
    result = CliRunner().invoke(cli, ["emualte", "observatory"])
    assert result.exit_code == 2
    assert "No such command 'emualte'. Did you mean 'emulate'?" in result.output


def test_a_locale_without_arrows() -> None:
    ended = subprocess.run(
        [sys.executable, "-m", "fieldtwin", "simulate", "observatory", "--for", "4s"],
        capture_output=True, check=False, env={**os.environ, "PYTHONPATH": str(ROOT), "PYTHONIOENCODING": "ascii"},
    )  # fmt: skip
    assert ended.returncode == 0, ended.stderr
    assert b"STANDBY -> " in ended.stdout + ended.stderr


def test_a_reader_that_closes_a_table_early_is_not_an_error() -> None:
    process = subprocess.Popen(
        [sys.executable, "-m", "fieldtwin", "faults"],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, env={**os.environ, "PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    assert process.stdout is not None
    process.stdout.close()
    process.stdout = None
    _, said = process.communicate(timeout=20)
    assert (process.returncode, said) == (0, b"")
