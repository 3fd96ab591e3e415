"""The place of a line in a Python program is the same on each computer and in each folder."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from fieldtwin.plc.program import within_import_path


@pytest.mark.parametrize("entry", [".", "site", ""])
def test_the_file_of_a_module_is_named_relative_to_its_entry_of_the_import_path(
    entry: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / (entry or "absolute")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [entry or str(folder), *sys.path])
    assert within_import_path(str(folder.resolve() / "plc" / "pump.py")) == "plc/pump.py"


def test_a_file_outside_the_import_path_keeps_its_path(tmp_path: Path) -> None:
    assert within_import_path(str(tmp_path / "pump.py")) == str(tmp_path / "pump.py")
