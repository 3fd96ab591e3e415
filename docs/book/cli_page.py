"""Generate the command line's reference from the commands themselves: the help of each, at 80 columns."""

from __future__ import annotations

import click

from fieldtwin.cli.main import COMMANDS, cli


def cli_page() -> str:
    """Return Markdown: a section for each command, in the order of the program's own list, subcommands after theirs."""
    parts = [
        "# Commands\n",
        "What `fieldtwin COMMAND --help` prints, of this version.\n",
        f"```text\n{_help(cli, 'fieldtwin', None)}\n```\n",
    ]
    parent = click.Context(cli, info_name="fieldtwin", terminal_width=80, max_content_width=80)
    for name in COMMANDS:
        command = cli.get_command(parent, name)
        if command is not None and not command.hidden:
            parts += _sections(command, name, parent, 2)
    return "\n".join(parts)


def _sections(command: click.Command, name: str, parent: click.Context, level: int) -> list[str]:
    context = click.Context(command, info_name=name, parent=parent, terminal_width=80, max_content_width=80)
    parts = [f"{'#' * level} {context.command_path}\n", f"```text\n{command.get_help(context)}\n```\n"]
    if isinstance(command, click.Group):
        for below in command.list_commands(context):
            found = command.get_command(context, below)
            if found is not None and not found.hidden:
                parts += _sections(found, below, context, level + 1)
    return parts


def _help(command: click.Command, name: str, parent: click.Context | None) -> str:
    return command.get_help(
        click.Context(command, info_name=name, parent=parent, terminal_width=80, max_content_width=80)
    )
