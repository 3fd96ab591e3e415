"""Every `fieldtwin` command on a page, in a fence or in a line of text, exists with the options shown."""

from __future__ import annotations

import ast
import json
import re
import shlex
from importlib import import_module

import click
import pytest
import yaml
from page_runner import ROOT

from fieldtwin.cli.default_group import DefaultGroup
from fieldtwin.cli.main import COMMANDS, cli

PAGES = [ROOT / name for name in ("README.md", "CONTRIBUTING.md", "SECURITY.md", "CHANGELOG.md")]
PAGES += [*sorted(p for p in (ROOT / "docs").rglob("*.md") if "decisions" not in p.parts)]
_FENCE = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
MISSPELT = "fieldtwin runn observatory:"
"""The walkthrough shows these commands because of their error messages."""
_INLINE = re.compile(r"`(fieldtwin\s[^`]+)`")


def shown(text: str) -> list[str]:
    """Return the command lines of a page: shell fences with continued lines joined, and commands in sentences."""
    found = []
    for language, body in _FENCE.findall(text):
        lines = body.replace("\\\n", " ").splitlines()
        if language in ("sh", "console", "bash"):
            found += [line.removeprefix("$ ") for line in lines if not (language == "console" and line[:2] != "$ ")]
        elif language == "yaml":
            found += [line.strip().removeprefix("- ").removeprefix("run: ") for line in lines if "fieldtwin " in line]
    found += [" ".join(inline.split()) for inline in _INLINE.findall(_FENCE.sub("", text))]
    return [part for line in found for part in _parts(line) if part[0] == "fieldtwin"]


def _parts(line: str) -> list[list[str]]:
    """Return the words of each command of a line, without a prefix such as variables or `timeout 5`."""
    lexer = shlex.shlex(line, posix=True, punctuation_chars="();<>|&")
    lexer.whitespace_split = True
    try:
        words = list(lexer)
    except ValueError:  # quotes of the sentence
        return []
    parts: list[list[str]] = [[]]
    for word in words:
        if re.fullmatch(r"[();<>|&]+", word):
            parts.append([])
        else:
            parts[-1].append(word)
    starts = [(part, part.index("fieldtwin")) for part in parts if "fieldtwin" in part]
    return [part[at:] for part, at in starts if at == 0 or "=" in part[0]]


def unknown(words: list[str]) -> str:
    """Return the parts of a command line that do not exist, as a text; empty if all exist."""
    command, words = cli, words[1:]
    if words and words[0] in ("COMMAND", "VERB"):
        return ""
    context = click.Context(cli)
    while isinstance(command, click.Group) and words and not words[0].startswith("-"):
        name = words.pop(0)
        choices = name.split("|") if "|" in name else [name.rstrip(",.")]
        below = [command.get_command(context, choice) for choice in choices]
        if None in below and isinstance(command, DefaultGroup):
            below = [command.default]
        if None in below:
            return f"no command {name!r}"
        command = below[0]
    if isinstance(command, DefaultGroup):
        command = command.default
    options = {
        option
        for parameter in command.get_params(context)
        if not getattr(parameter, "hidden", False)  # an option that has moved to another command
        for option in (*parameter.opts, *parameter.secondary_opts)
    }
    options |= {"--help", "-h"}
    for word in words:
        if word == "--":
            break
        if word.startswith("-") and not re.fullmatch(r"-|-?\d.*|-[a-zA-Z]\S+", word):
            option = word.partition("=")[0].rstrip(",.:")
            if any(one not in options for one in option.split("|") if one.startswith("-")):
                return f"{command.name} has no {option!r}"
    return ""


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_every_command_on_a_page_exists(page):
    wrong = [f"{' '.join(words)}: {why}" for words in shown(page.read_text("utf-8")) if (why := unknown(words))]
    wrong = [line for line in wrong if not line.startswith(MISSPELT)]
    assert not wrong, "\n".join(wrong)


def test_every_command_is_shown_on_a_page():
    told = {words[1] for page in PAGES for words in shown(page.read_text("utf-8")) if len(words) > 1}
    assert set(COMMANDS) - told == set()


def test_a_command_that_there_is_not_is_noticed():
    lines = "A=1 fieldtwin run x --protoype | head; fieldtwin plc nothing; fieldtwin run x --virtual"
    page = f"`fieldtwin rnu x`\n```sh\n{lines}\n```\n"
    assert [unknown(words) for words in shown(page)] == [
        "run has no '--protoype'", "no command 'nothing'", "run has no '--virtual'", "no command 'rnu'",
    ]  # fmt: skip


def fences(*languages: str) -> list[tuple[str, str]]:
    """Return (page, text) of all fences in these languages."""
    texts = [(page.relative_to(ROOT).as_posix(), page.read_text("utf-8")) for page in PAGES]
    return [(name, body) for name, text in texts for language, body in _FENCE.findall(text) if language in languages]


def test_yaml_and_json_of_the_pages_can_be_read():
    assert all(yaml.safe_load(body) is not None for _, body in fences("yaml"))
    for _, body in fences("json"):
        lines = body.splitlines()
        for value in lines if all(line.endswith(("}", "]")) for line in lines) else [body]:
            json.loads(value)


def test_python_of_the_pages_compiles_and_imports_existing_names():
    ours = {"fieldtwin", "gateway", "plc", "twin", "emulators"}
    for page, body in fences("python"):
        for node in ast.walk(ast.parse(body, page)):
            if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] in ours:
                module = import_module(node.module)
                assert all(hasattr(module, name.name) for name in node.names), f"{page}: {ast.unparse(node)}"


def test_compose_files_of_the_pages_use_existing_options():
    files = [(page, found) for page, body in fences("yaml") if "services" in (found := yaml.safe_load(body))]
    assert {page for page, _ in files} >= {"docs/tutorials/pump-station.md", "docs/tutorials/own-controller.md"}
    for page, found in files:
        for service in found["services"].values():
            if str(service.get("image", "")).startswith("fieldtwin:"):
                assert unknown(["fieldtwin", *service["command"]]) == "", page
