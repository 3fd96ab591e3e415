"""The shipped JSON schemas are those of the forms that read the files, and shipped files are valid against them."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
from jsonschema import Draft202012Validator

from fieldtwin.gateway.core.files.yaml_file import load
from fieldtwin.site.check import check_site
from fieldtwin.site.schemas import SCHEMAS, SHIPPED, schema_text, shipped

CHECKOUT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize("kind", SCHEMAS)
def test_a_shipped_schema_is_that_of_its_form(kind: str) -> None:
    assert shipped(kind).read_text("utf-8") == schema_text(kind), "scripts/schemas --write makes it anew"


def test_the_folder_has_no_other_file() -> None:
    assert {path.name for path in SHIPPED.iterdir()} == {shipped(kind).name for kind in SCHEMAS}


def test_the_script_finds_no_difference() -> None:
    assert subprocess.run([sys.executable, str(CHECKOUT / "scripts" / "schemas")], check=False).returncode == 0


@pytest.mark.long
@pytest.mark.parametrize("folder", ["profiles", "examples", "tests/emulators/faults/scenarios"])
def test_an_editor_shows_no_error_in_a_file_that_the_program_accepts(folder: str) -> None:
    files = check_site(CHECKOUT / folder).files
    assert len(files) > 2
    for name, kind in files.items():
        if kind == "compose":  # its schema is that of the Compose Specification, not ours
            continue
        schema = json.loads(shipped({"device": "profile"}.get(kind, kind)).read_text("utf-8"))
        data = json.loads(json.dumps(load(CHECKOUT / folder / name).data))
        errors = [
            f"{name}: {list(e.absolute_path)}: {e.message}" for e in Draft202012Validator(schema).iter_errors(data)
        ]
        assert errors == []
