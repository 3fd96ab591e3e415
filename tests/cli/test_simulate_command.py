"""`fieldtwin simulate`, and the options that have moved to it from `fieldtwin run`."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import click
import pytest
from click.shell_completion import BashComplete
from click.testing import CliRunner

from fieldtwin.cli.main import cli
from fieldtwin.cli.run.run_command import command as run
from fieldtwin.cli.run.simulate_command import command as simulate
from fieldtwin.gateway.core.errors import UsageError

MOVED = {
    "--virtual": [], "--seed": ["0"], "--seeds": ["1..2"], "--jobs": ["2"], "--ledger": ["l.jsonl"], "--trace": ["t.jsonl"],
    "--compare": ["t.jsonl"], "--fault-every": ["1min"], "--fault-kinds": ["drop"], "--fault-aims": ["ctd"],
}  # fmt: skip


def sentence(name: str) -> str:
    return f"`fieldtwin run` has no {name}: use `fieldtwin simulate SYSTEM --for 24h`, which runs a prototype in virtual time"


@pytest.mark.parametrize("name", MOVED)
@pytest.mark.parametrize("others", [(), ("observatory", "--prototype", "--for", "1s"), ("observatory", "--plant")])
def test_an_option_that_moved_names_the_new_command(name: str, others: tuple[str, ...]) -> None:
    done = CliRunner().invoke(run, [*others, name, *MOVED[name]])
    assert isinstance(done.exception, UsageError), done.output
    assert str(done.exception) == sentence(name)


def test_random_faults_of_a_run_name_the_new_command() -> None:
    done = CliRunner().invoke(run, ["observatory", "--prototype", "--faults", "random"])
    assert isinstance(done.exception, UsageError), done.output
    assert str(done.exception) == sentence("--faults random")


def test_the_exit_code_of_an_option_that_moved_is_2_with_one_line() -> None:
    words = ["run", "observatory", "--prototype", "--virtual", "--for", "1h", "--seed", "7"]
    done = subprocess.run(
        [sys.executable, "-m", "fieldtwin", *words], capture_output=True, text=True, timeout=50, check=False
    )
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == f"fieldtwin: {sentence('--virtual')}\n"


def test_a_variable_of_an_option_that_moved_names_the_new_command(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FIELDTWIN_RUN_SEED", "7")
    done = CliRunner().invoke(cli, ["run", "observatory", "--prototype"])
    assert str(done.exception) == sentence("--seed")


def test_an_option_that_moved_is_not_completed_and_not_in_help() -> None:
    completed = BashComplete(cli, {}, "fieldtwin", "_FIELDTWIN_COMPLETE").get_completions(["run", "x"], "--")
    assert {"--prototype", "--capture"} <= {item.value for item in completed}
    assert not {item.value for item in completed} & set(MOVED)
    text = CliRunner().invoke(cli, ["run", "--help"]).stdout
    assert not any(f"  {name} " in text for name in MOVED)


def test_simulate_has_every_option_that_moved() -> None:
    assert set(MOVED) - {"--virtual"} <= {name for parameter in simulate.params for name in parameter.opts}


def test_options_of_simulate_come_from_the_environment() -> None:
    env = {
        **os.environ, "FIELDTWIN_SIMULATE_DURATION_S": "3s", "FIELDTWIN_SIMULATE_SEEDS": "4..5",
        "FIELDTWIN_SIMULATE_AS_JSON": "1", "FIELDTWIN_SIMULATE_COMMANDS": "none",
    }  # fmt: skip
    done = subprocess.run(
        [sys.executable, "-m", "fieldtwin", "simulate", "observatory"],
        capture_output=True, text=True, timeout=50, check=False, env=env,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert [one["seed"] for one in json.loads(done.stdout)["results"]] == [4, 5]


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["ocean_network"], "simulate needs an end time"),
        (["ocean_network", "--for", "1s", "--speed", "2"], "--speed: not available for a network"),
        (["observatory", "--for", "1s", "--fault-every", "1s"], "--fault-every, --fault-kinds and --fault-aims choose"),
    ],
)
def test_unsupported_requests_are_refused_with_the_reason(words: list[str], told: str) -> None:
    done = CliRunner().invoke(simulate, words)
    assert isinstance(done.exception, UsageError), done.output
    assert told in str(done.exception)


def test_the_command_line_lists_simulate() -> None:
    text = CliRunner().invoke(cli, ["--help"]).stdout
    assert "Simulate a system in virtual time" in " ".join(text.split())
    assert isinstance(cli.get_command(click.Context(cli), "simulate"), click.Command)
