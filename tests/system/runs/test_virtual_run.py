"""A whole prototype in virtual time, from the command line: the same seed gives the same events, byte for byte."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from fieldtwin.run.virtual.run import VirtualOptions, VirtualRun

SHORT = ["--for", "20s", "--json"]


def fieldtwin(*words: str, hash_seed: str = "0") -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "fieldtwin", "simulate", "observatory", *words],
        capture_output=True,
        text=True,
        timeout=50,
        check=False,
        env={**os.environ, "PYTHONHASHSEED": hash_seed},
    )


def run(*words: str, hash_seed: str = "0") -> dict[str, Any]:
    ended = fieldtwin(*SHORT, *words, hash_seed=hash_seed)
    assert ended.returncode == 0, ended.stdout + ended.stderr
    summary: dict[str, Any] = json.loads(ended.stdout)
    return summary


@pytest.mark.long
def test_the_same_seed_gives_the_same_bytes(tmp_path: Path) -> None:
    first = run("--seed", "7", "--trace", str(tmp_path / "a.jsonl"))
    second = run("--seed", "7", "--trace", str(tmp_path / "b.jsonl"), hash_seed="1")
    assert first == second
    assert (tmp_path / "a.jsonl").read_bytes() == (tmp_path / "b.jsonl").read_bytes()
    assert len((tmp_path / "a.jsonl").read_bytes().splitlines()) == first["trace"]["events"]
    assert first["states"] == {"relay": ["STANDBY", "ACTIVE", "STANDBY", "OFF"]}
    assert first["published"]["checked"] > 400
    assert first["published"]["wrong"] == 0
    assert first["outputs_safe"] is True
    assert first["devices"]["ctd"] == {"state": "good", "error": "", "plays": "cast.jsonl (synthetic)"}
    assert first["devices"]["modem"]["plays"] == "the model mailbox"
    assert first["exchanges"]["line1"]["gateway"] == first["exchanges"]["line1"]["emulators"]


@pytest.mark.long
def test_several_seeds_run_in_several_processes() -> None:
    ended = fieldtwin(*SHORT, "--seeds", "1..3", "--jobs", "2")
    told = json.loads(ended.stdout)
    assert [r["seed"] for r in told["results"]] == [1, 2, 3]
    assert told["failed"] == []
    assert len({r["sha256"] for r in told["results"]}) > 1  # the modems' link loses different packets


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ([], "simulate needs an end time"),
        (["--for", "1s", "--ledger", "hours.jsonl"], "--ledger needs --seeds"),
        (["--for", "1s", "--seeds", "5..1"], "the lower first"),
        (["--for", "1s", "--seeds", "1..2", "--seed", "1"], "need a single run"),
    ],
)
def test_invalid_options_are_refused(words: list[str], told: str) -> None:
    from click.testing import CliRunner

    from fieldtwin.cli.run.simulate_command import command
    from fieldtwin.gateway.core.errors import UsageError

    result = CliRunner().invoke(command, ["observatory", *words])
    assert isinstance(result.exception, UsageError)
    assert told in str(result.exception)


def test_a_command_that_is_due_between_two_instants_is_sent() -> None:
    """Defect: 0.1 x 3 s is a little more than 0.3 s; the run waited for less than a nanosecond without end."""
    made = VirtualRun(VirtualOptions("observatory", 3.0, commands=(1, 2, 0, -1)))
    made.run()
    assert made.errors == []
    shore = made.checks[""].topside
    assert shore is not None
    assert shore.commands_sent == [1, 2, 0, -1]
