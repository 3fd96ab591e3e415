"""A folder is a concept, so it holds few modules (docs/decisions/0038)."""

from __future__ import annotations

import re
from collections import Counter
from pathlib import Path

ROOT = Path(__file__).parents[2]
PACKAGES = ("gateway", "plc", "emulators", "twin", "fieldtwin")
MOST = 15
MORE = {"emulators/faults/canopen": 16}
"""Folders with more modules, and how many. Each fault is one module."""


def test_no_folder_of_the_product_holds_more_than_15_modules() -> None:
    counts = Counter(
        path.parent.relative_to(ROOT).as_posix()
        for package in PACKAGES
        for path in (ROOT / package).rglob("*.py")  # does not follow the links from fieldtwin/ to the others
        if path.name != "__init__.py"
    )
    assert counts["plc/st"], "the modules were not found"
    too_many = {folder: count for folder, count in counts.items() if count > MORE.get(folder, MOST)}
    assert not too_many, "split these folders into concepts"


def test_each_folder_of_modules_is_a_package_that_states_its_concept() -> None:
    silent = [
        folder.relative_to(ROOT).as_posix()
        for package in PACKAGES
        for folder in {path.parent for path in (ROOT / package).rglob("*.py")}
        if not (folder / "__init__.py").is_file() or '"""' not in (folder / "__init__.py").read_text(encoding="utf-8")
    ]
    assert not silent


def test_marks_that_select_files_are_in_the_files_of_the_tests() -> None:
    elsewhere = [
        path.relative_to(ROOT).as_posix()
        for path in (ROOT / "tests").rglob("*.py")
        if not path.name.startswith("test_")
        and path != ROOT / "tests" / "conftest.py"  # it marks the property tests, and does not omit them
        and re.search(r"mark\.(long|socketcan)\b", path.read_text(encoding="utf-8"))
    ]
    assert not elsewhere, "pytest_ignore_collect of tests/conftest.py would omit tests that get the mark from here"
