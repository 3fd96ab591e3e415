"""docs/how-to/ci.md: the recipes are YAML in the form of the services, and call fieldtwin with existing options."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import click
import pytest
import yaml
from click.testing import CliRunner

from fieldtwin.cli.main import cli

PAGE = Path(__file__).resolve().parents[2] / "docs" / "how-to" / "ci.md"
RECIPES = re.findall(r"^<!-- recipe: (\w+) -->\n```yaml\n(.*?)^```$", PAGE.read_text("utf-8"), re.MULTILINE | re.DOTALL)


def commands_of(service: str, text: str) -> list[str]:
    """Return the shell lines of a recipe; fail if the recipe does not have the form of the service."""
    recipe = yaml.safe_load(text)
    if service == "gitlab":
        jobs = recipe.values()
        assert all(job["artifacts"]["when"] == "always" and job["image"] for job in jobs)
        return [line for job in jobs for line in job["script"]]
    assert recipe.keys() == {"name", True, "permissions", "jobs"}  # `on` is a boolean of YAML 1.1
    steps = [step for job in recipe["jobs"].values() for step in job["steps"]]
    assert all(("uses" in step) != ("run" in step) for step in steps)
    assert all(re.fullmatch(r"[\w-]+/[\w-]+@v\d+", step["uses"]) for step in steps if "uses" in step)
    return [line for step in steps for line in step.get("run", "").splitlines()]


def parsed(command: str) -> click.Context:
    """Parse the command line without running it. Raises click.UsageError for unknown options."""
    words = shlex.split(command.split(" > ")[0])
    assert words.pop(0) == "fieldtwin"
    name = words.pop(0)
    found = cli.get_command(click.Context(cli), name)
    assert found is not None, name
    return found.make_context(name, words)


@pytest.mark.parametrize(("service", "text"), RECIPES)
def test_a_recipe_has_its_format_and_its_commands_exist(service, text):
    ours = [line for line in commands_of(service, text) if line.startswith("fieldtwin")]
    assert ours
    for line in ours:
        assert parsed(line) is not None


def test_scenarios_leave_junit_and_html_on_both_services():
    told = {service for service, text in RECIPES if "--junit out/" in text and "--html out/" in text}
    assert told == {"github", "gitlab"}
    on_vcan = [(service, text) for service, text in RECIPES if "--can socketcan/vcan0" in text]
    assert {service for service, _ in on_vcan} == {"github", "gitlab"}
    assert all("--junit out/" in text and "--html out/" in text and "always" in text for _, text in on_vcan)


def test_the_first_recipe_leaves_its_artefacts_in_a_fresh_checkout(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a.scenario.yaml").write_text(
        'scenario: a\nsystem: observatory\nsteps:\n  - wait: {until: "plc.late < 1 s"}\n'
    )
    line = next(line for line in commands_of(*RECIPES[0]) if line.startswith("fieldtwin test"))
    done = CliRunner().invoke(cli, shlex.split(line)[1:], standalone_mode=False)
    assert (done.exception, done.return_value) == (None, 0)
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"scenarios.xml", "scenarios.html"}


def test_an_option_that_there_is_not_is_noticed():
    with pytest.raises(click.UsageError):
        parsed("fieldtwin test --junti out.xml")
