"""The support tables of the page about Structured Text: the compiler gives each dialect's answer for an example of each row."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import yaml
from page_runner import ROOT

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.plc.st.dialects import DIALECTS
from fieldtwin.plc.st.project import compile_source

PAGE = ROOT / "docs" / "reference" / "structured-text.md"
EXAMPLES: dict[str, str] = yaml.safe_load((Path(__file__).parent / "structured_text_support.yaml").read_text("utf-8"))
COLUMNS = "| feature | example | `standard` | `matiec` | `codesys`, `twincat` |"


def stated() -> dict[str, list[str]]:
    """Return the cells of each row by the name of its feature: the answers for standard, matiec, codesys and twincat."""
    text = PAGE.read_text("utf-8")
    found = {}
    for table in text.split(COLUMNS)[1:]:
        for row in table.split("\n\n")[0].splitlines()[2:]:
            feature, *_, standard, matiec, vendors = (cell.strip() for cell in row.strip("|").split(" | "))
            found[re.sub(r"\[(.*)\]\(.*\)", r"\1", feature)] = [standard, matiec, vendors, vendors]
    return found


def answer(source: Path, dialect: str) -> str:
    """Return what the table says for a source: `yes`, the ids of its warnings, or a dash if the dialect refuses it."""
    try:
        unit = compile_source(source, DIALECTS[dialect])
    except FileInvalid:
        return "–"
    return ", ".join(sorted({warning.id for warning in unit.warnings})) or "yes"


def test_every_feature_of_the_tables_has_an_example() -> None:
    assert list(EXAMPLES), "no examples"
    assert sorted(stated()) == sorted(EXAMPLES)


@pytest.mark.parametrize("feature", EXAMPLES)
def test_the_compiler_answers_as_the_table_says(feature: str, tmp_path: Path) -> None:
    text = EXAMPLES[feature]
    source = tmp_path / "main.st"
    source.write_text(text if "END_PROGRAM" in text else f"PROGRAM Main\n{text}\nEND_PROGRAM\n", "utf-8")
    assert [answer(source, dialect) for dialect in ("standard", "matiec", "codesys", "twincat")] == stated()[feature]
