"""Generate the troubleshooting page from the code: every error class with its meaning, and every message as it is printed.

The messages are the texts in ``raise Kind("...")`` and in calls of the files' `error("...")`, which the syntax tree of each
module holds. Values that are filled in appear as ``<name>``.
"""

from __future__ import annotations

import ast
import importlib
import inspect
import pkgutil
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import fieldtwin
from fieldtwin.explain.errors import ERRORS
from fieldtwin.gateway.core.errors import Bug, FieldtwinError, FileInvalid

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("fieldtwin", "gateway", "plc", "emulators", "twin")
FILE_ERROR = "error"
"""The method of a loaded file that makes a `FileInvalid` with path, line and column."""


@dataclass(frozen=True, order=True)
class Message:
    """A message: its class, the text with placeholders, and the hints that the code adds to it."""

    kind: str
    text: str
    expected: str
    hint: str
    module: str


@cache
def kinds() -> dict[str, type[FieldtwinError]]:
    """Return all error classes by name. Modules whose library is not installed are left out."""
    for module in pkgutil.walk_packages(fieldtwin.__path__, "fieldtwin."):
        if not module.name.endswith("__main__"):
            try:
                importlib.import_module(module.name)
            except ImportError:
                continue

    def below(kind: type[FieldtwinError]) -> Iterator[type[FieldtwinError]]:
        yield kind
        for each in kind.__subclasses__():
            yield from below(each)

    return {kind.__name__: kind for kind in below(FieldtwinError) if kind.__module__.startswith("fieldtwin.")}


@cache
def messages() -> tuple[Message, ...]:
    """Return every message of the code with a fixed text, sorted by class and text."""
    found: set[Message] = set()
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            if not path.is_symlink() and not any(part.is_symlink() for part in path.parents if ROOT in part.parents):
                found.update(_of_module(path))
    return tuple(sorted(found))


def _of_module(path: Path) -> Iterator[Message]:
    name = ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
    for node in ast.walk(ast.parse(path.read_text("utf-8"))):
        if not isinstance(node, ast.Call):
            continue
        called = getattr(node.func, "id", getattr(node.func, "attr", ""))
        kind = "FileInvalid" if called == FILE_ERROR and isinstance(node.func, ast.Attribute) else called
        if kind not in kinds() or issubclass(kinds()[kind], Bug):
            continue
        text = next((spelled for argument in node.args if (spelled := _spelled(argument))), "")
        if not text.replace("<", " ").strip() or (text.startswith("<") and text.endswith(">") and text.count("<") == 1):
            continue  # the text comes from elsewhere, where it is found too
        named = {word.arg: _spelled(word.value) for word in node.keywords if word.arg}
        yield Message(kind, text, named.get("expected", ""), named.get("hint", ""), name)


def _spelled(node: ast.expr) -> str:
    """Return a text as it is printed, with ``<name>`` for values; or an empty text for other expressions."""
    if isinstance(node, ast.Constant):
        return node.value if isinstance(node.value, str) else ""
    if isinstance(node, ast.JoinedStr):
        return "".join(_piece(part) for part in node.values)
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
        return _spelled(node.left) + (_spelled(node.right) or f"<{_name(node.right)}>")
    if isinstance(node, ast.IfExp):
        return _spelled(node.body) or _spelled(node.orelse)
    return ""


def _piece(part: ast.expr) -> str:
    if isinstance(part, ast.FormattedValue):
        name = f"<{_name(part.value)}>"
        return f"'{name}'" if part.conversion == ord("r") else name
    return part.value if isinstance(part, ast.Constant) and isinstance(part.value, str) else ""


def _name(node: ast.expr) -> str:
    """Return a word for a value: the last name in its expression."""
    names = [
        getattr(n, "attr", getattr(n, "id", "")) for n in ast.walk(node) if isinstance(n, ast.Attribute | ast.Name)
    ]
    plain = [name for name in names if name not in ("self", "str", "len", "join", "sorted", "repr", "int", "hex")]
    return (plain or ["value"])[0].strip("_")


def troubleshooting_page() -> str:
    """Return the page as Markdown."""
    todo = {entry.id: entry for entry in ERRORS}
    parts = [
        "# Troubleshooting\n",
        "Search this page for the text of an error as it is printed, without the values in it: `<name>` stands for a value."
        " The text after *expected* and the words in parentheses follow the message on the same line, and the place (file,"
        " line, bus, unit ID) precedes it. The page is generated from the program's own messages. `fieldtwin explain ERROR`"
        " explains a class.\n",
        "| class | exit code | at fault | messages |\n|---|---|---|---|",
    ]
    of = {name: [m for m in messages() if m.kind == name] for name in kinds()}
    for name, kind in sorted(kinds().items()):
        parts.append(
            f"| [{name}](#error-class-{name.lower()}) | {kind.exit_code} | {kind.blame.value} | {len(of[name])} |"
        )
    parts.append("")
    for name, kind in sorted(kinds().items()):
        nearest = next((todo[base.__name__] for base in kind.__mro__ if base.__name__ in todo), None)
        parts += [f"(error-class-{name.lower()})=", f"## {name}\n", f"{_meaning(kind)} Exit code {kind.exit_code}.\n"]
        if nearest is not None:
            parts.append(f"**What to do:** {nearest.todo}\n")
        if issubclass(kind, FileInvalid):
            parts.append("The message begins with the file, the line and the column.\n")
        parts += _rows(of[name])
    return "\n".join(parts)


def _meaning(kind: type[FieldtwinError]) -> str:
    return " ".join((inspect.getdoc(kind) or "").partition("\n\n")[0].split()).replace("`", "")


def _rows(of: list[Message]) -> Iterator[str]:
    if of:
        yield "| message | expected | what to do | from |\n|---|---|---|---|"
        for message in of:
            yield f"| {_code(message.text)} | {_code(message.expected)} | {_code(message.hint)} | `{message.module}` |"
        yield ""


def _code(text: str) -> str:
    """Return a text as inline code in a table, "" for an empty one."""
    plain = " ".join(text.replace("|", "\\|").split())
    return f"`` {plain} ``" if "`" in plain else f"`{plain}`" if plain else ""
