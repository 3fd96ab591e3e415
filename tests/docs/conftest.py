"""The source of the book, which several files of tests examine."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from page_runner import ROOT

sys.path.insert(0, str(ROOT / "docs" / "book"))

import stage as book


@pytest.fixture(scope="session")
def staged(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of the book's source. Tests only read it, so it is made once, which takes seconds."""
    folder = tmp_path_factory.mktemp("book") / "source"
    book.stage(folder)
    return folder
