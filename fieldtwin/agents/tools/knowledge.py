"""Tools that look things up: files of the project, explanations, kinds of faults, drawings and checks of files."""

from __future__ import annotations

import asyncio
from dataclasses import asdict
from pathlib import Path
from typing import Any

import msgspec

from fieldtwin.agents.project import shipped_systems
from fieldtwin.agents.tool import Tool
from fieldtwin.agents.workplace import Workplace
from fieldtwin.emulators.faults.description import describe_fault
from fieldtwin.emulators.faults.registry import FAULTS
from fieldtwin.explain.lookup import explain
from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.gateway.core.files.yaml_file import parse
from fieldtwin.reports.drawing.tree import tree
from fieldtwin.reports.drawing.wiring import wiring
from fieldtwin.scenarios.language.file_name import SUFFIX
from fieldtwin.scenarios.language.form import Scenario, read_scenario
from fieldtwin.twin.prototype.file import load_prototype
from fieldtwin.twin.site.data_files import data_root
from fieldtwin.twin.site.system import load_system


class OfFile(msgspec.Struct, forbid_unknown_fields=True):
    """A file of the project. `path` is relative to the project."""

    path: str


class OfWords(msgspec.Struct, forbid_unknown_fields=True):
    """A word of a message, a test case, a fault, an exception code, a quality or its reason, such as ``stale``."""

    words: str


class OfSystem(msgspec.Struct, forbid_unknown_fields=True):
    """A system file of the project, or the name of a shipped system. `prototype`: also what is emulated."""

    system: str
    prototype: bool = False


class OfText(msgspec.Struct, forbid_unknown_fields=True):
    """The text of a scenario. `path` is where it would be saved; files that it names are relative to that folder."""

    text: str
    path: str = f"draft{SUFFIX}"


async def list_files(work: Workplace, _: Any) -> dict[str, Any]:
    """Return the readable files of the project by kind, and the shipped systems."""
    files, complete = await asyncio.to_thread(work.project.files)
    return {"files": files, "complete": complete, "shipped_systems": shipped_systems()}


async def read_file(work: Workplace, given: OfFile) -> str:
    """Return the text of a file."""
    return await asyncio.to_thread(work.project.read, given.path)


async def explain_words(work: Workplace, given: OfWords) -> list[dict[str, Any]]:
    """Return the explanations of a word."""
    return [asdict(entry) for entry in explain(given.words)]


async def list_faults(work: Workplace, _: Any) -> list[dict[str, Any]]:
    """Return every kind of fault with its parameters as JSON schema, and the keys by which it is aimed."""
    return [describe_fault(kind) for kind in FAULTS.values()]


async def draw_system(work: Workplace, given: OfSystem) -> str:
    """Return the buses, devices, programs and servers of a system as a tree."""

    def draw() -> str:
        system = load_system(work.project.system(given.system))
        return tree(wiring(system, load_prototype(system) if given.prototype else None))

    return await asyncio.to_thread(draw)


async def check_system(work: Workplace, given: OfSystem) -> dict[str, Any]:
    """Return the errors of a system file and, with `prototype`, of its prototype file. No bus is opened."""

    def load() -> None:
        system = load_system(work.project.system(given.system))
        if given.prototype:
            load_prototype(system)

    return await asyncio.to_thread(_checked, load)


async def check_scenario(work: Workplace, given: OfText) -> dict[str, Any]:
    """Return the errors of a scenario's text. Nothing is written."""
    return await asyncio.to_thread(_checked, lambda: scenario_of(work, given.text, given.path))


def scenario_of(work: Workplace, text: str, path: str) -> Scenario:
    """Return a checked scenario. Raises `FileInvalid` for its errors, also if its system or prototype file is outside of the
    project, because their Python code would be executed.
    """
    place = work.project.inside(path)
    scenario = read_scenario(parse(text, str(place)), place)
    files = {"system": Path(scenario.system.path)}
    if scenario.form.prototype is not None:
        files["prototype"] = place.parent / scenario.form.prototype
    for key, file in files.items():
        if not any(file.resolve().is_relative_to(folder) for folder in (work.project.folder, data_root().resolve())):
            raise scenario.file.error((key,), f"the {key} is outside of the project", got=str(file))
    return scenario


def _checked(load: Any) -> dict[str, Any]:
    try:
        load()
    except FileInvalid as e:
        return {"ok": False, "errors": [str(found) for found in (e, *e.others)]}
    return {"ok": True, "errors": []}


TOOLS = (
    Tool("list_files", "List the files of the project by kind, and the shipped systems.", list_files),
    Tool("read_file", "Read a text file of the project.", read_file, OfFile),
    Tool(
        "explain",
        "Explain a word of a message: a quality or its reason, a fault, an error, an exception or abort code, a test case.",
        explain_words,
        OfWords,
    ),
    Tool("list_faults", "List the kinds of faults that can be injected into a prototype.", list_faults),
    Tool("draw_system", "Draw the buses, devices, programs and servers of a system.", draw_system, OfSystem),
    Tool("check_system", "Check a system file, and its prototype file, without running them.", check_system, OfSystem),
    Tool("check_scenario", "Check the text of a scenario without saving or running it.", check_scenario, OfText),
)
