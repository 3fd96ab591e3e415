"""The mutations of tests/mutations fit the program and name existing tests; scripts/mutate proves that they are caught."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[2]
MUTATIONS = [
    pytest.param(entry, id=f"{path.stem}-{number}-{entry['case']}")
    for path in sorted((ROOT / "tests" / "mutations").glob("*.toml"))
    for number, entry in enumerate(tomllib.loads(path.read_text())["mutation"])
]


@pytest.mark.parametrize("mutation", MUTATIONS)
def test_mutation_fits(mutation: dict[str, Any]) -> None:
    assert set(mutation) == {"case", "file", "before", "after", "test"}
    assert (ROOT / mutation["file"]).read_text().count(mutation["before"]) == 1
    assert mutation["before"] != mutation["after"]
    file, _, name = mutation["test"].partition("::")
    assert f"def {name.partition('[')[0]}(" in (ROOT / file).read_text()
