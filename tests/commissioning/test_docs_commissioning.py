"""Every option that the pages name for line, scan and identify exists."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import click
import pytest

from fieldtwin.cli.main import cli

DOCS = Path(__file__).parents[2] / "docs"
PAGE = (DOCS / "how-to" / "commissioning.md").read_text(encoding="utf-8")
SCAN = (DOCS / "explanation" / "scanning.md").read_text(encoding="utf-8")
LINES = [line for line in re.findall(r"```sh\n(.*?)```", PAGE, re.S)[0].splitlines() if line]


@pytest.mark.parametrize("line", LINES)
def test_a_command_line_of_the_page_is_understood(line: str) -> None:
    name, *arguments = shlex.split(line)[1:]
    command = cli.get_command(click.Context(cli), name)
    assert command is not None
    assert command.make_context(name, arguments).params


@pytest.mark.parametrize(
    ("name", "heading"), [("line", "Check the wire"), ("scan", "scan"), ("identify", "Identify a device")]
)
def test_every_option_that_the_page_names_exists(name: str, heading: str) -> None:
    command = cli.get_command(click.Context(cli), name)
    assert command is not None
    known = {option for parameter in command.params for option in parameter.opts}
    pages = f"{PAGE}\n## scan\n{SCAN}"
    section = pages.split(f"\n## {heading}\n")[1].split("\n## ")[0].replace("(then use `--echo`)", "")
    assert set(re.findall(r"`(--[a-z-]+)", section)) <= known
