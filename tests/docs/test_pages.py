"""The pages of docs/ that show commands: each command is executed as written, and its output compared."""

from __future__ import annotations

import tempfile
from pathlib import Path

import pytest
from page_runner import ROOT, Block, Reader, agrees, blocks, commands, is_long

PAGES = [page for page in sorted((ROOT / "docs").rglob("*.md")) if blocks(page)]


def _as_test(page: Path):
    marks = [pytest.mark.long, pytest.mark.timeout(900)] if is_long(page) else []
    return pytest.param(page, id=page.relative_to(ROOT / "docs").as_posix(), marks=marks)


@pytest.mark.parametrize("page", [_as_test(page) for page in PAGES])
def test_the_output_on_a_page_is_true(page):
    # short, because socket paths are created below it
    with tempfile.TemporaryDirectory(prefix="pg", dir="/tmp") as folder:
        reader = Reader(Path(folder))
        try:
            for block in blocks(page):
                reader.does(block)
        finally:
            reader.ends()


def test_a_tutorial_cannot_be_left_out():
    tutorials = {page.name for page in (ROOT / "docs" / "tutorials").glob("*.md")} - {"README.md", "examples.md"}
    assert tutorials <= {page.name for page in PAGES}


def test_a_page_with_wrong_output_is_detected(tmp_path):
    reader = Reader(tmp_path)
    reader.does(Block("file", "a.txt", "one\n", 1))
    reader.does(Block("run", "", "$ cat a.txt\none\n", 3))
    with pytest.raises(AssertionError, match="line 5: cat"):
        reader.does(Block("run", "", "$ cat a.txt\ntwo\n", 5))


def test_output_is_compared_with_its_gaps():
    assert agrees("a ... c\n...\nd", "a b c\nx\ny\nd  \n")
    assert not agrees("a ... c", "a b d")
    assert not agrees("a", "a\nb")
    assert commands("$ one\nsays\n$ two\n") == [("one", "says"), ("two", "")]


def test_numbers_may_differ_only_where_the_page_allows_it():
    assert agrees("seed 1  | took 12.5 s", "seed 27 |  took 3 s", numbers=True)
    assert not agrees("took 12.5 s", "took 3 s")
    assert not agrees("took 12.5 s", "took 3 ms", numbers=True)


def test_a_page_changes_into_a_folder(tmp_path):
    reader = Reader(tmp_path)
    reader.does(Block("file", "site/a.txt", "one\n", 1))
    reader.does(Block("run", "", "$ cd site\n$ cat a.txt\none\n", 3))
    with pytest.raises(AssertionError, match="line 5: cd gone"):
        reader.does(Block("run", "", "$ cd gone\n", 5))
