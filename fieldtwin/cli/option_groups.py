"""Named groups of options in `--help`, and frozen dataclasses of options that several commands share.

A command lists its groups in the order in which `--help` shows them:

    @click.command("simulate", cls=GroupedCommand)
    @group("Simulated devices", replay=ReplayOptions)
    @group("Output", click.option("--trace"), json_option)
    def command(replay: ReplayOptions, trace: str, as_json: bool) -> int: ...

Each field of a dataclass such as ``ReplayOptions`` is declared with `option`. This module does not depend on any command or
option.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import field, fields
from functools import wraps
from typing import Any

import click

from fieldtwin.gateway.core.errors import UsageError

_DECLARATION = "option"
_HEADINGS = "option_headings"
_OTHER = "Other options"
_WIDEST = 30
"""Maximum width of the options' column: the default of `click.HelpFormatter.write_dl`."""

Decorator = Callable[[Callable[..., Any]], Callable[..., Any]]


def option(*names: str, **attributes: Any) -> Any:
    """Declare a field of a frozen dataclass as a command-line option, with the arguments of `click.option`.

    The name of the field is the name of the parameter, also in the environment variable FIELDTWIN_COMMAND_FIELD.
    """
    return field(metadata={_DECLARATION: (names, attributes)})


def group(heading: str, *options: Decorator, **shared: type[Any]) -> Decorator:
    """Add options to a command, which `GroupedCommand` shows in this order below `heading`.

    The command gets each class of `shared` as one argument, an object whose fields are the options' values.
    """

    def add(function: Callable[..., Any]) -> Callable[..., Any]:
        grown: Callable[..., Any] = _taking(shared, function) if shared else function
        declared: list[Decorator] = [
            click.option(*f.metadata[_DECLARATION][0], f.name, **f.metadata[_DECLARATION][1])
            for part in shared.values()
            for f in fields(part)
        ]
        before = len(_parameters(grown))
        for each in reversed([*options, *declared]):
            grown = each(grown)
        headings = vars(grown).setdefault(_HEADINGS, {})
        headings.update({parameter.name: heading for parameter in _parameters(grown)[before:]})
        return grown

    return add


def _taking(shared: dict[str, type[Any]], function: Callable[..., Any]) -> Callable[..., Any]:
    @wraps(function)
    def with_objects(*args: Any, **values: Any) -> Any:
        objects = {name: part(**{f.name: values.pop(f.name) for f in fields(part)}) for name, part in shared.items()}
        return function(*args, **objects, **values)

    return with_objects


def _parameters(function: Callable[..., Any]) -> list[click.Parameter]:
    """Return the parameters that click's decorators have added, the last first."""
    found: list[click.Parameter] = getattr(function, "__click_params__", [])
    return found


class GroupedCommand(click.Command):
    """A command whose `--help` shows the options under the headings of their groups, with one width for all groups."""

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        headings = getattr(self.callback, _HEADINGS, {})
        rows: dict[str, list[tuple[str, str]]] = {}
        for parameter in self.get_params(ctx):
            record = parameter.get_help_record(ctx)
            if record is not None and isinstance(parameter, click.Option):
                rows.setdefault(headings.get(parameter.name, _OTHER), []).append(record)
        rows[_OTHER] = rows.pop(_OTHER, [])  # this group is shown last
        lengths = [len(names) for records in rows.values() for names, _ in records]
        width = max(length for length in lengths if length <= _WIDEST)  # a longer option is shown on a separate line
        for heading, records in rows.items():
            with formatter.section(heading):
                formatter.write_dl([(names.ljust(width), text) for names, text in records], col_max=width)


def moved_options(sentence: str, *names: str, is_flag: bool = False) -> Decorator:
    """Add hidden options that a command no longer has.

    Using such an option raises `UsageError` with `sentence`, in which {} stands for the option.
    """

    def refuse(ctx: click.Context, parameter: click.Parameter, value: Any) -> None:
        if value:
            raise UsageError(sentence.format(parameter.opts[0]))

    def add(function: Callable[..., Any]) -> Callable[..., Any]:
        for name in names:
            function = click.option(
                name, is_flag=is_flag, default=None, hidden=True, expose_value=False, is_eager=True, callback=refuse
            )(function)
        return function

    return add
