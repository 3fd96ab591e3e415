"""Commands do not import what they do not need, because imports are most of the CPU time of a short command."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

HEAVY = {"asyncua", "can", "canopen", "distributed", "lark", "mcp", "pydantic", "pymodbus", "starlette", "z3"}


def imported(folder: Path, *arguments: str) -> set[str]:
    """Return the heavy packages that `fieldtwin` imports when it is called with these arguments."""
    command = [sys.executable, "-X", "importtime", "-m", "fieldtwin", *arguments]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True)
    lines = [line for line in done.stderr.splitlines() if line.startswith("import time:")]
    return {line.rpartition("|")[2].strip().partition(".")[0] for line in lines} & HEAVY


@pytest.mark.parametrize(
    ("command", "needed"),
    [
        ("--version", set()),
        ("--help", set()),
        ("plc --help", set()),
        ("plc check pump.st", {"lark"}),
    ],
)
def test_a_command_imports_only_the_packages_that_it_needs(command: str, needed: set[str], tmp_path: Path) -> None:
    (tmp_path / "pump.st").write_text("PROGRAM pump VAR a : INT; END_VAR a := a + 1; END_PROGRAM\n")
    assert imported(tmp_path, *command.split()) == needed
