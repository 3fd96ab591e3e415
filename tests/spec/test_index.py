"""No row of the specification is without a test here: the schemas that docs/paper.md has in its table, and the prose."""

from __future__ import annotations

import re
from pathlib import Path

HERE = Path(__file__).parent
PROSE_ROWS = 11


def test_index_every_schema_of_the_paper_is_looked_at() -> None:
    page = (HERE.parents[1] / "docs" / "paper.md").read_text(encoding="utf-8")
    table = page[page.index("## Schemas and classes") : page.index("## Where the emulated connection is")]
    rows = [line.split("|")[1] for line in table.splitlines() if line.startswith("| ")][1:]
    schemas = {word for row in rows for word in re.findall(r"\b[A-Z][A-Za-z0-9]{3,}\b", row)}
    assert len(schemas) >= 50
    tests = "\n".join(p.read_text(encoding="utf-8") for p in HERE.glob("test_schema_*.py"))
    assert {name for name in schemas if not re.search(rf"\b{name}\b|_{name}_", tests)} == set()


def test_index_every_row_of_the_prose_has_a_test() -> None:
    names = re.findall(r"^def test_prose_(\d+)_", "\n".join(p.read_text() for p in HERE.glob("test_prose*.py")), re.M)
    assert {int(number) for number in names} == set(range(1, PROSE_ROWS + 1))
