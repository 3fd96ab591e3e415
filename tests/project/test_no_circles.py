"""No two files import each other, not even for their types, and not indirectly."""

from __future__ import annotations

import ast
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
FOLDERS = "gateway", "plc", "emulators", "twin", "fieldtwin"


def imports(files: dict[str, str]) -> dict[str, set[str]]:
    """Return, by module, the modules among `files` (sources by module) that it imports anywhere. Imports are absolute."""
    found: dict[str, set[str]] = {}
    for module, source in files.items():
        names = found[module] = set()
        for node in ast.walk(ast.parse(source)):
            if isinstance(node, ast.Import):
                names.update(alias.name for alias in node.names)
            elif isinstance(node, ast.ImportFrom) and node.module:
                inner = {f"{node.module}.{alias.name}" for alias in node.names}
                names.update(inner & files.keys() if inner <= files.keys() else inner | {node.module})
        names &= files.keys() - {module}
    return found


def module_of(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts if parts[0] == "fieldtwin" else ("fieldtwin", *parts)).removesuffix(".__init__")


def test_no_file_imports_itself_by_a_detour() -> None:
    files = {module_of(p): p.read_text() for folder in FOLDERS for p in (ROOT / folder).rglob("*.py")}
    assert len(files) > 500
    TopologicalSorter(imports(files)).prepare()  # raises CycleError, which names the circle


def test_a_circle_would_be_found() -> None:
    circle = {"a.b": "from a import c", "a.c": "def f():\n    from a.d import g", "a.d": "import a.b", "a": ""}
    with pytest.raises(CycleError) as error:
        TopologicalSorter(imports(circle)).prepare()
    assert {"a.b", "a.c", "a.d"} == set(error.value.args[1])
