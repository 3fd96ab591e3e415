"""Every row of the specification has a test here: the table of schemas in docs/explanation/paper.md, the prose, the rulings."""

from __future__ import annotations

import ast
import re
from pathlib import Path

HERE = Path(__file__).parent
PROSE_ROWS = 11
RULINGS = 18


def test_index_every_schema_of_the_paper_is_looked_at() -> None:
    page = (HERE.parents[1] / "docs" / "explanation" / "paper.md").read_text(encoding="utf-8")
    table = page[page.index("## Schemas and classes") : page.index("## Where the emulated connection is")]
    rows = [line.split("|")[1] for line in table.splitlines() if line.startswith("| ")][1:]
    schemas = {word for row in rows for word in re.findall(r"\b[A-Z][A-Za-z0-9]{3,}\b", row)}
    assert len(schemas) >= 50
    tests = "\n".join(p.read_text(encoding="utf-8") for p in HERE.rglob("test_schema_*.py"))
    assert {name for name in schemas if not re.search(rf"\b{name}\b|_{name}_", tests)} == set()


def test_index_every_row_of_the_prose_has_a_test() -> None:
    names = re.findall(r"^def test_prose_(\d+)_", "\n".join(p.read_text() for p in HERE.rglob("test_prose*.py")), re.M)
    assert {int(number) for number in names} == set(range(1, PROSE_ROWS + 1))


def rulings_named(text: str) -> set[int]:
    """Return the numbers after ``ruling`` and ``rulings``: ``ruling 7``, ``Rulings 8 and 16``, ``Rulings 1, 2 and 5``."""
    said = re.findall(r"\b[Rr]ulings? (\d+(?:(?:, | and )\d+)*)", text)
    return {int(number) for words in said for number in re.findall(r"\d+", words)}


def test_index_every_ruling_is_named_by_a_test_that_shows_it() -> None:
    """In the test itself: its docstring, or the text of an assertion."""
    page = (HERE.parents[1] / "docs" / "explanation" / "paper.md").read_text(encoding="utf-8")
    rulings = {int(number) for number in re.findall(r"^\*\*(\d+)\. ", page[page.index("## Rulings") :], re.M)}
    assert rulings == set(range(1, RULINGS + 1))
    shown: set[int] = set()
    for path in HERE.rglob("test_*.py"):
        if path != Path(__file__):
            functions = [n for n in ast.walk(ast.parse(path.read_text())) if isinstance(n, ast.FunctionDef)]
            shown |= {n for f in functions if f.name.startswith("test_") for n in rulings_named(ast.unparse(f))}
    assert rulings - shown == set()
