"""`fieldtwin completion`: print or install the completion of commands, options and arguments for a shell."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import click

from fieldtwin.console import stderr
from fieldtwin.gateway.core.errors import UsageError

NEEDED = {
    "bash": "bash needs its package bash-completion for this; without the package add this line to ~/.bashrc: . {path}",
    "zsh": "add these lines to ~/.zshrc, before compinit: fpath+=~/.zfunc; autoload -Uz compinit && compinit",
}
"""The lines that a user must add for a shell, so that it loads the completion file."""


@click.command("completion")
@click.argument("shell", type=click.Choice(["bash", "zsh", "fish"]))
@click.option(
    "--install", is_flag=True, help="Write it to the file from which the shell loads it, instead of to stdout."
)
def command(shell: str, install: bool) -> int:
    """Print the script that completes commands, options, names of systems and explained words in SHELL.

    With --install it is written where the shell finds it; a new shell uses it then.
    """
    from fieldtwin.cli.completions import place_of, script_of
    from fieldtwin.cli.main import cli

    script = script_of(shell, cli)
    if not install:
        sys.stdout.write(script)
        return 0
    data, config = os.environ.get("XDG_DATA_HOME"), os.environ.get("XDG_CONFIG_HOME")
    path = place_of(shell, Path.home(), Path(data) if data else None, Path(config) if config else None)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(script, encoding="utf-8")
    except OSError as e:
        raise UsageError(f"cannot write {path}: {e.strerror}", hint=f"fieldtwin completion {shell} prints it") from e
    stderr.print(f"written to {path}; a new {shell} uses it", soft_wrap=True, markup=False, highlight=False)
    if shell in NEEDED:
        stderr.print(NEEDED[shell].format(path=path), soft_wrap=True, markup=False, highlight=False)
    return 0
