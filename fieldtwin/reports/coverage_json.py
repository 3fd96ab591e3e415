"""Coverage of Structured Text as JSON: counts of each file, and every place that was not executed."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from fieldtwin.plc.st.coverage.places import Coverage, Kind
from fieldtwin.reports.file import put


def write_coverage(coverage: Coverage, path: Path) -> None:
    """Write the file. Raises `FileInvalid` if that is not possible."""
    put(path, json.dumps(coverage_as_data(coverage), indent=2) + "\n")


def coverage_as_data(coverage: Coverage) -> dict[str, Any]:
    """Return the coverage as data for JSON. Lines and columns begin with 1."""
    return {
        "kind": "fieldtwin test coverage",
        "version": 1,
        "files": [{"path": path, **_of_file(coverage.of(path))} for path in coverage.paths],
    }


def _of_file(coverage: Coverage) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for kind in Kind:
        executed, every = coverage.count(kind)
        missed = [
            {"line": one.line, "column": one.column, "pou": one.pou, "name": one.name} for one in coverage.missed(kind)
        ]
        found[kind.value] = {"executed": executed, "of": every, "missed": missed}
    return found
