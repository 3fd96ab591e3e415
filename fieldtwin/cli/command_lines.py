"""Checks a command line of fieldtwin that a file contains, such as a compose file, without running it."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence

import click

from fieldtwin.cli.default_group import DefaultGroup
from fieldtwin.cli.main import COMMANDS, cli
from fieldtwin.gateway.core.files.nearest import did_you_mean
from fieldtwin.site.compose.service import WrongWord

_OPTION = re.compile(r"(--?[A-Za-z][\w-]*)(?:=|$)")
_OPEN = "${"
"""The beginning of a variable whose value is unknown until compose runs."""


def wrong_words(words: Sequence[str]) -> Iterator[WrongWord]:
    """Yield each wrong word of a command line, with its index: the command, options that it does not have, and values that
    an option refuses. A value with a variable is not checked.
    """
    context = click.Context(cli, info_name="fieldtwin")
    command: click.Command = cli
    at = 0
    while isinstance(command, click.Group) and at < len(words) and not words[at].startswith("-"):
        inner = command.get_command(context, words[at])
        if inner is None and isinstance(command, DefaultGroup):
            break
        if inner is None:
            known = command.list_commands(context)
            yield WrongWord(at, f"no command {words[at]!r}", hint=did_you_mean(words[at], known))
            return
        command, context, at = inner, click.Context(inner, info_name=words[at], parent=context), at + 1
    if isinstance(command, DefaultGroup):
        command = command.default
    yield from _wrong_arguments(command, context, words, at)


def _wrong_arguments(
    command: click.Command, context: click.Context, words: Sequence[str], at: int
) -> Iterator[WrongWord]:
    known = [name for param in command.get_params(context) for name in (*param.opts, *param.secondary_opts)]
    known = [name for name in known if name.startswith("-")]
    kept: list[str] = []
    for index, word in enumerate(words[at:], at):
        if word == "--":
            kept += words[index:]
            break
        option = _OPTION.match(word)
        if option and option[1] not in known:
            yield WrongWord(index, f"{words[0]} has no option {option[1]!r}", hint=did_you_mean(option[1], known))
        else:
            kept.append(word)
    try:
        values, rest, order = command.make_parser(context).parse_args(kept)
    except click.UsageError as e:
        yield WrongWord(_index_of(words, at, e), e.format_message())
        return
    for param in click.core.iter_params_for_processing(order, command.get_params(context)):
        given = values.get(param.name or "")
        if _OPEN in str(given) or param.is_eager:
            continue
        try:
            param.handle_parse_result(context, values, rest)
        except click.UsageError as e:
            yield WrongWord(_index_of(words, at, e, str(given)), e.format_message())


def _index_of(words: Sequence[str], at: int, error: click.UsageError, value: str = "") -> int:
    """Return the index of the word that an error is about, or 0, the index of the command."""
    names = tuple(getattr(getattr(error, "param", None), "opts", ())) or (getattr(error, "option_name", ""),)
    for index, word in enumerate(words[at:], at):
        if word.partition("=")[0] in names or (value and word == value):
            return index
    return 0


def variables_of(command: str) -> list[str]:
    """Return the environment variables of a command's options; an unknown command has none."""
    inner = cli.get_command(click.Context(cli), command) if command in COMMANDS else None
    if isinstance(inner, DefaultGroup):
        inner = inner.default
    if inner is None:
        return []
    return [f"FIELDTWIN_{command}_{param.name}".upper().replace("-", "_") for param in inner.params]
