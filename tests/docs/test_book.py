"""The book of docs/: its links work, and its reference matches the program. scripts/docs builds it."""

from __future__ import annotations

import re
import sys
from importlib import import_module
from itertools import pairwise

import pytest
from page_runner import ROOT

sys.path.insert(0, str(ROOT / "docs" / "book"))

import explain_page
import form_pages
import paper_page
import stage as book

import fieldtwin
from fieldtwin.cli.main import COMMANDS
from fieldtwin.site.schemas import SCHEMAS


def test_links_between_files_work():
    pages = book.pages()
    for source, page in pages.items():
        book.with_links((ROOT / source).read_text("utf-8"), source, page, pages)


def test_a_link_to_nothing_is_named_with_its_line():
    with pytest.raises(book.BrokenLink, match=r"docs/reference/plc\.md:2: nothing is at gone\.md"):
        book.with_links("one\n[x](gone.md#y)\n", "docs/reference/plc.md", "reference/plc.md", book.pages())


def test_links_are_those_of_the_book():
    shown = "[a](docs/reference/plc.md#x) ![b](docs/pictures/picture.svg)"
    text, beside = book.with_links(shown, "README.md", "readme.md", book.pages())
    assert text == "[a](reference/plc.md#x) ![b](pictures/picture.svg)"
    assert beside == {"docs/pictures/picture.svg": "pictures/picture.svg"}


def test_a_heading_is_at_most_one_level_below_the_heading_before_it():
    for source in book.pages():
        if not source.endswith(".md"):
            continue
        text = re.sub(r"^( *)(`{3,}).*?^\1\2", "", (ROOT / source).read_text("utf-8"), flags=re.MULTILINE | re.DOTALL)
        headings = re.findall(r"^(#+) (.*)", text, re.MULTILINE)
        for (before, _), (level, title) in pairwise(headings):
            assert len(level) <= len(before) + 1, f"{source}: {title}"


def test_every_page_is_in_one_table_of_contents(staged):
    listed = []
    for page in staged.rglob("*.md"):
        for entries in re.findall(
            r"^```{toctree}\n(?::[^\n]*\n)*\n(.*?)^```", page.read_text("utf-8"), re.MULTILINE | re.DOTALL
        ):
            listed += [
                (page.parent / f"{entry}.md").resolve().relative_to(staged.resolve()) for entry in entries.split()
            ]
    pages = [page.relative_to(staged) for page in staged.rglob("*.md") if "files" not in page.relative_to(staged).parts]
    assert sorted(listed) == sorted(page for page in pages if page.as_posix() != "index.md")


def test_pages_of_a_kind_are_grouped_by_the_subjects_of_its_index():
    index = "# Reference\n\n## Files\n\n- [A](a.md), and [b](b.md) *\n\n## One page\n\n[c](c.md) and [a](a.md)\n"
    texts = {f"reference/{name}.md": f"# {name}\n" for name in ("a", "b", "c", "left")}
    pages = book.with_indexes(texts | {"reference/README.md": index}, [])
    assert pages["reference/README.md"] == f"{index}\n```{{toctree}}\n:hidden:\n\nsubject-files\nc\nleft\n```\n"
    expected = "# Files\n\n- [A](a.md), and [b](b.md)\n\n```{toctree}\n:hidden:\n\na\nb\n```\n"
    assert pages["reference/subject-files.md"] == expected


def test_every_page_lies_in_the_folder_of_its_kind():
    folders = {page.relative_to(ROOT / "docs").parts[0] for page in (ROOT / "docs").rglob("*.md")}
    assert folders - {"troubleshooting", "troubleshooting.md"} == {*book.KINDS, "decisions", "index.md"}


def test_every_schema_of_the_paper_has_classes_that_there_are():
    rows = paper_page.rows(paper_page.PAPER.read_text("utf-8"))
    schemas = {name.strip() for row in rows for name in row.schemas.split(",")}
    documents = {"Document", "BluePrint", "TechnicalManual", "BillOfMaterials", "Generic"}
    concepts = {"PhysicalTwin", "DigitalModel", "DigitalTemplate", "DigitalThread", "DigitalShadow", "DigitalTwin"}
    assert schemas >= {*documents, *concepts, "DigitalTwinPrototype"}
    assert all(row.classes for row in rows)


def test_a_class_that_there_is_not_is_named():
    with pytest.raises(paper_page.NoSuchClass, match=r"no class Twin in fieldtwin\.twin\.model\.twin"):
        paper_page.rows(
            "## Schemas and classes\n| schema | class | where |\n| DigitalTwin | `Twin` | `fieldtwin.twin.model.twin` |\n"
        )


def test_the_books_source_has_every_kind_of_file_every_fault_and_every_command(staged):
    assert set(form_pages.KINDS) == set(SCHEMAS)
    commands = (staged / "reference/cli.md").read_text("utf-8")
    assert all(f"## fieldtwin {name}\n" in commands for name in COMMANDS)
    faults = (staged / "reference/faults.md").read_text("utf-8")
    assert all(f"`{name}`" in faults for name in form_pages.FAULTS)


def test_every_explanation_has_an_anchor_of_its_own(staged):
    page = (staged / "reference/explanations.md").read_text("utf-8")
    anchors = re.findall(r"^\((.+)\)=$", page, re.MULTILINE)
    assert len(anchors) == len(set(anchors)) == len(explain_page.described())
    assert {
        "exception-02",
        "abort-06020000",
        "stale",
        "error-crcerror",
        "exit-4",
        "fault-late-reply",
    } <= set(anchors)


def test_the_public_api_equals_the_reference():
    page = (ROOT / "docs/reference/api.md").read_text("utf-8")
    told = re.findall(r"^\.\. auto\w+:: ([\w.]+)$", page, re.MULTILINE)
    assert {name.removeprefix("fieldtwin.") for name in told} >= set(fieldtwin.__all__) - {"__version__"}
    for name in told:
        module, _, own = name.rpartition(".")
        assert getattr(import_module(module), own).__doc__, name
