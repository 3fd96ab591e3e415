"""Options in named groups: every command with many options shows them below headings, and receives shared ones as objects."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator
from dataclasses import dataclass

import click
import pytest
from click.testing import CliRunner

from fieldtwin.cli.main import cli
from fieldtwin.cli.option_groups import GroupedCommand, group, moved_options, option
from fieldtwin.gateway.core.errors import UsageError

MANY = 12
"""A command with more options than this shows them in groups."""
MOST_PARAMETERS = 18


def commands(above: click.Group = cli, words: tuple[str, ...] = ()) -> Iterator[tuple[str, click.Command]]:
    context = click.Context(above)
    for name in above.list_commands(context):
        command = above.get_command(context, name)
        assert command is not None
        if isinstance(command, click.Group):
            yield from commands(command, (*words, name))
        else:
            yield " ".join((*words, name)), command


ALL = dict(commands())
LARGE = [name for name, command in ALL.items() if sum(isinstance(p, click.Option) for p in command.params) > MANY]


def headings(name: str) -> dict[str, list[str]]:
    """Return the options of a command's `--help` by heading, in the order shown."""
    text = CliRunner().invoke(cli, [*name.split(), "--help"]).stdout
    found: dict[str, list[str]] = {}
    shown: list[str] = []
    for line in text.splitlines():
        if re.fullmatch(r"[A-Z][^.]*:", line):
            shown = found.setdefault(line[:-1], [])
        elif match := re.match(r"  (?:-\w, )?(--[\w-]+)", line):
            shown.append(match[1])
    return found


def test_commands_with_many_options_are_known() -> None:
    assert {"run", "simulate", "emulate", "test", "record", "check modbus", "check canopen-master", "twin"} <= set(
        LARGE
    )


@pytest.mark.parametrize("name", LARGE)
def test_each_option_is_shown_once_below_a_named_heading(name: str) -> None:
    shown = headings(name)
    assert shown.pop("Other options") == ["--help"]
    assert len(shown) >= 3
    visible = [p.opts[-1] for p in ALL[name].params if isinstance(p, click.Option) and not p.hidden]
    assert sorted(one for options in shown.values() for one in options) == sorted(visible)


@pytest.mark.parametrize("name", LARGE)
def test_options_of_a_group_are_shared_instead_of_many_parameters(name: str) -> None:
    callback = ALL[name].callback
    assert callback is not None
    assert len(inspect.signature(inspect.unwrap(callback)).parameters) <= MOST_PARAMETERS


@pytest.mark.parametrize("name", ALL)
def test_help_fits_into_80_columns(name: str) -> None:
    lines = CliRunner().invoke(cli, [*name.split(), "--help"]).stdout.splitlines()
    choices = re.compile(r"\s+(-\w, )?--[\w-]+ \[[^]]*\|[^]]*\]")  # a list of choices is one word
    assert [line for line in lines if len(line) > 80 and not choices.match(line)] == []


def test_headings_of_run_and_simulate() -> None:
    assert list(headings("run")) == [
        "Plant or prototype", "Simulated devices", "Digital thread", "Profiles and templates", "Output", "Other options",
    ]  # fmt: skip
    shown = headings("simulate")
    assert shown["Virtual time and seeds"] == ["--for", "--seed", "--seeds", "--shard", "--jobs", "--on", "--ledger"]
    assert shown["Faults"] == ["--faults", "--fault-every", "--fault-kinds", "--fault-aims"]
    assert shown["Output"] == [
        "--trace",
        "--variable",
        "--compare",
        "--json",
        "--junit",
        "--junit-flavour",
        "--html",
        "--coverage",
    ]
    assert shown["Profiles and templates"] == headings("run")["Profiles and templates"]


@dataclass(frozen=True)
class Limits:
    """Two options that several commands would share."""

    rate: float = option("--rate", default=20.0, help="Requests per second.")
    names: tuple[str, ...] = option("--name", multiple=True, help="A name.")


@click.command(cls=GroupedCommand)
@group("Limits", limits=Limits)
@group("Output", click.option("--json", "as_json", is_flag=True, help="JSON."))
@group("Limits", click.option("--long", help="A second option of the first group."))
@moved_options("`old` has no {}: use `new`", "--gone")
@moved_options("`old` has no {}: use `new`", "--flag-gone", is_flag=True)
def example(limits: Limits, as_json: bool, long: str | None) -> None:
    """Print what the command receives."""
    click.echo(f"{limits} {as_json} {long}")


def test_a_group_becomes_one_object_with_values_of_words_and_environment() -> None:
    runner = CliRunner()
    got = runner.invoke(example, ["--rate", "2", "--name", "a", "--name", "b", "--json"])
    assert got.stdout == f"{Limits(2.0, ('a', 'b'))} True None\n"
    got = runner.invoke(example, [], env={"X_RATE": "3", "X_LONG": "y"}, auto_envvar_prefix="X")
    assert got.stdout == f"{Limits(3.0, ())} False y\n"


def test_groups_of_one_heading_are_shown_together() -> None:
    text = CliRunner().invoke(example, ["--help"]).stdout
    order = [
        text.index(word) for word in ("Limits:", "--rate", "--name", "--long", "Output:", "--json", "Other options:")
    ]
    assert order == sorted(order)
    assert text.count("Limits:") == 1
    assert "gone" not in text


@pytest.mark.parametrize("words", [["--gone", "0"], ["--gone=0"], ["--flag-gone"]])
def test_a_moved_option_is_refused(words: list[str]) -> None:
    got = CliRunner().invoke(example, words)
    assert isinstance(got.exception, UsageError)
    assert str(got.exception) == f"`old` has no {words[0].partition('=')[0]}: use `new`"
