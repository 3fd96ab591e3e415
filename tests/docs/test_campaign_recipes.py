"""docs/how-to/many-computers.md: each recipe has its service's form, and its shards have all seeds once."""

from __future__ import annotations

import re
import shlex
import subprocess
from pathlib import Path

import click
import pytest
import yaml

from fieldtwin.cli.main import cli

PAGE = Path(__file__).resolve().parents[2] / "docs" / "how-to" / "many-computers.md"
RECIPES = dict(
    re.findall(r"^<!-- recipe: ([\w-]+) -->\n```\w+\n(.*?)^```$", PAGE.read_text("utf-8"), re.MULTILINE | re.DOTALL)
)


def github() -> tuple[list[str], list[dict[str, str]]]:
    jobs = yaml.safe_load(RECIPES["github-campaign"])["jobs"]
    shards = jobs["shard"]["strategy"]["matrix"]["shard"]
    lines = [step["run"] for job in jobs.values() for step in job["steps"] if "run" in step]
    return [line.replace("${{ matrix.shard }}", "$SHARD") for line in lines], [{"SHARD": str(one)} for one in shards]


def gitlab() -> tuple[list[str], list[dict[str, str]]]:
    jobs = yaml.safe_load(RECIPES["gitlab-campaign"])
    count = jobs["shard"]["parallel"]
    lines = [line for name in jobs["stages"] for line in jobs["shard" if name == "run" else name]["script"]]
    return lines, [{"CI_NODE_INDEX": str(n), "CI_NODE_TOTAL": str(count)} for n in range(1, count + 1)]


def slurm() -> tuple[list[str], list[dict[str, str]]]:
    text = RECIPES["slurm-campaign"]
    first, last = re.search(r"--array=(\d+)-(\d+)", text).groups()  # type: ignore[union-attr]
    count = int(last) - int(first) + 1
    of = {"SLURM_ARRAY_TASK_COUNT": str(count), "SLURM_CPUS_PER_TASK": "4"}
    lines = text.replace("\\\n", " ").splitlines()
    return lines, [{**of, "SLURM_ARRAY_TASK_ID": str(n)} for n in range(int(first), int(last) + 1)]


def kubernetes() -> tuple[list[str], list[dict[str, str]]]:
    spec = yaml.safe_load(RECIPES["kubernetes-campaign"])["spec"]
    [line] = spec["template"]["spec"]["containers"][0]["args"]
    return [line.removeprefix("exec ")], [{"JOB_COMPLETION_INDEX": str(n)} for n in range(spec["completions"])]


def expanded(line: str, variables: dict[str, str]) -> list[str]:
    """Return the words of a command line after a shell has replaced its variables."""
    done = subprocess.run(
        ["sh", "-c", f"printf '%s\\n' {line.strip()}"], env=variables, capture_output=True, text=True, check=True
    )
    return done.stdout.splitlines()


@pytest.mark.parametrize("recipe", [github, gitlab, slurm, kubernetes])
def test_the_shards_of_a_recipe_have_all_seeds_once(recipe):
    lines, environments = recipe()
    [line] = [one for one in lines if one.startswith("fieldtwin simulate")]
    command = cli.get_command(click.Context(cli), "simulate")
    seeds: list[int] = []
    ledgers = set()
    for variables in environments:
        words = expanded(line, variables)
        runs = command.make_context("simulate", words[2:]).params
        seeds += parse(runs)
        ledgers.add(runs["ledger"])
    assert sorted(seeds) == list(range(1, len(seeds) + 1))
    assert len(ledgers) == len(environments)


@pytest.mark.parametrize("recipe", ["dask-slurm-command", "dask-kubernetes-command"])
def test_the_command_of_a_recipe_for_dask_is_valid(recipe):
    words = shlex.split(RECIPES[recipe])
    params = cli.get_command(click.Context(cli), "simulate").make_context("simulate", words[2:]).params
    assert params["on"] == recipe.split("-")[1]
    assert params["jobs"] > 1


@pytest.mark.parametrize(("recipe", "part"), [("dask-slurm", "jobqueue"), ("dask-kubernetes", "kubernetes")])
def test_a_file_for_dask_is_yaml(recipe, part):
    assert list(yaml.safe_load(RECIPES[recipe])) == [part]


def parse(params: dict[str, object]) -> list[int]:
    from fieldtwin.run.campaigns.seeds import parse_seeds

    return list(parse_seeds(str(params["seeds"]), str(params["shard"])))


@pytest.mark.parametrize("recipe", [github, gitlab])
def test_a_recipe_joins_the_ledgers_of_all_its_jobs(recipe):
    lines, _ = recipe()
    [line] = [one for one in lines if one.startswith("fieldtwin campaign")]
    words = shlex.split(line)
    group = cli.get_command(click.Context(cli), words[1])
    params = group.commands[words[2]].make_context("merge", words[3:]).params
    [run] = [one for one in lines if one.startswith("fieldtwin simulate")]
    assert f"--seeds {params['seeds']}" in run
    assert str(params["ledgers"][0]) == "shard-*.jsonl"
