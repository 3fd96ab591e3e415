"""Generate the paper's schemas as classes: the table of docs/explanation/paper.md, as existing classes with their docstrings."""

from __future__ import annotations

import re
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules
from types import ModuleType

PAPER = Path(__file__).resolve().parents[1] / "explanation" / "paper.md"
_NAME = re.compile(r"[A-Za-z]\w+")


class NoSuchClass(Exception):
    """The table names a class that is in none of its modules; the message names it."""


@dataclass(frozen=True, slots=True)
class Row:
    """A line of the table: the schemas, and the classes for them with their full names."""

    schemas: str
    classes: tuple[str, ...]


def rows(text: str) -> list[Row]:
    """Return the table under "Schemas and classes". Raises NoSuchClass, and ImportError for a missing module."""
    table = text.split("## Schemas and classes", 1)[1].split("\n## ", 1)[0]
    found = []
    for line in table.splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        if line.startswith("| ") and cells[0] != "schema":
            found.append(_row(*cells))
    return found


def _row(schemas: str, classes: str, where: str) -> Row:
    names = []
    if "same name" in classes:
        names = [name.strip() for name in re.split(r",| and ", schemas) if _NAME.fullmatch(name.strip())]
    names += re.findall(rf"`({_NAME.pattern})`", classes)
    modules = [module for path in re.findall(r"`([\w.]+)`", where) for module in _with_those_below(import_module(path))]
    return Row(schemas, tuple(_place(name, modules) for name in names))


def _with_those_below(module: ModuleType) -> list[ModuleType]:
    below = iter_modules(getattr(module, "__path__", ()))
    return [module, *(import_module(f"{module.__name__}.{one.name}") for one in below)]


def _place(name: str, modules: list[ModuleType]) -> str:
    for module in modules:
        if isinstance(found := getattr(module, name, None), type):
            return f"{found.__module__}.{found.__qualname__}"
    raise NoSuchClass(f"no class {name} in {', '.join(module.__name__ for module in modules)}")


def paper_page() -> str:
    """Return Markdown: each schema, its classes, and their docstrings."""
    parts = [
        "# The paper's classes\n",
        "Each schema of [the paper](../explanation/paper.md), the classes that stand for it, and what those say of themselves."
        " `pytest tests/spec` holds the schemas against them.\n",
    ]
    for row in rows(PAPER.read_text("utf-8")):
        directives = "\n".join(f".. autoclass:: {name}\n   :no-index:" for name in row.classes)
        parts += [f"## {row.schemas}\n", f"```{{eval-rst}}\n{directives}\n```\n"]
    return "\n".join(parts)
