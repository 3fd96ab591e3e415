"""Every command line of the pages about registers is accepted by the commands."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import click
import pytest

from fieldtwin.cli.main import cli

HOW_TO = Path(__file__).parents[2] / "docs" / "how-to"
PAGE = "".join((HOW_TO / page).read_text(encoding="utf-8") for page in ("maps.md", "dump.md", "infer.md"))
BLOCKS = "\n".join(re.findall(r"```sh\n(.*?)```", PAGE, re.S))
LINES = [line for line in BLOCKS.splitlines() if line.startswith("fieldtwin ")]
COMMANDS = ("read", "write", "watch", "dump", "diff", "infer")


@pytest.mark.parametrize("line", LINES)
def test_a_command_line_of_the_page_is_understood(line: str) -> None:
    name, *arguments = shlex.split(line.split("#")[0])[1:]
    command = cli.get_command(click.Context(cli), name)
    assert command is not None
    assert command.make_context(name, arguments).params


def test_every_option_that_the_pages_name_exists() -> None:
    known = {
        option
        for name in (*COMMANDS, "emulate")
        for parameter in cli.get_command(click.Context(cli), name).params  # type: ignore[union-attr]
        for option in (*parameter.opts, *parameter.secondary_opts)
    }
    assert set(re.findall(r"`(--[a-z-]+)", PAGE)) <= known
