"""Completion in shells: the scripts, where they are installed, and what a real bash offers."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from click.testing import CliRunner

from fieldtwin.cli.main import cli

PLACES = {
    "bash": ".local/share/bash-completion/completions/fieldtwin",
    "zsh": ".zfunc/_fieldtwin",
    "fish": ".config/fish/completions/fieldtwin.fish",
}


def offered(*words: str) -> list[str]:
    """Return what the shell offers for the last of `words`."""
    env = {
        **os.environ,
        "COMP_WORDS": " ".join(("fieldtwin", *words)),
        "COMP_CWORD": str(len(words)),
        "_FIELDTWIN_COMPLETE": "bash_complete",
    }
    done = subprocess.run(
        [sys.executable, "-c", "import sys; sys.argv[0] = 'fieldtwin'; from fieldtwin.cli.main import main; sys.exit(main())"],
        env=env, capture_output=True, text=True, check=False, timeout=30,
    )  # fmt: skip
    return [line.partition(",")[2] for line in done.stdout.splitlines()]


@pytest.mark.parametrize("shell", PLACES)
def test_the_script_is_written_where_the_shell_finds_it(
    shell: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.delenv("XDG_DATA_HOME", raising=False)
    monkeypatch.delenv("XDG_CONFIG_HOME", raising=False)
    printed = CliRunner().invoke(cli, ["completion", shell], standalone_mode=False, catch_exceptions=False)
    assert "_FIELDTWIN_COMPLETE" in printed.stdout
    CliRunner().invoke(cli, ["completion", shell, "--install"], standalone_mode=False, catch_exceptions=False)
    assert (tmp_path / PLACES[shell]).read_text(encoding="utf-8") == printed.stdout


def test_bash_accepts_the_script(tmp_path: Path) -> None:
    script = CliRunner().invoke(cli, ["completion", "bash"], standalone_mode=False, catch_exceptions=False).stdout
    (tmp_path / "c").write_text(script, encoding="utf-8")
    done = subprocess.run(
        ["bash", "-c", f"source {tmp_path / 'c'} && complete -p fieldtwin"], capture_output=True, text=True, check=False
    )
    assert (done.returncode, "_fieldtwin_completion" in done.stdout) == (0, True), done.stderr


def test_the_line_for_a_bash_without_its_package_for_completion_works(tmp_path: Path) -> None:
    env = {**os.environ, "HOME": str(tmp_path), "XDG_DATA_HOME": str(tmp_path / "data")}
    install = [sys.executable, "-m", "fieldtwin", "completion", "bash", "--install"]
    said = subprocess.run(install, env=env, capture_output=True, text=True, check=True, timeout=60).stderr
    line = said.strip().rpartition("~/.bashrc: ")[2]
    (tmp_path / "rc").write_text(line + "\n", encoding="utf-8")
    bash = ["bash", "--norc", "-c", f"source {tmp_path / 'rc'} && complete -p fieldtwin"]
    done = subprocess.run(bash, env=env, capture_output=True, text=True, check=False)
    assert "_fieldtwin_completion" in done.stdout, (said, done.stderr)


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (("simu",), ["simulate"]),
        (("run", "obs"), ["observatory"]),
        (("explain", "mb-015"), ["MB-015a", "MB-015b"]),
        (("run", "observatory", "--proto"), ["--prototype", "--prototype-file"]),
    ],
)
def test_commands_systems_words_and_options_are_offered(words: tuple[str, ...], expected: list[str]) -> None:
    assert offered(*words) == expected
