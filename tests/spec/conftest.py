"""`pytest tests/spec` prints the paper's specification: each schema, and the properties that were shown for it.

A test is named ``test_<Schema>_<what_must_hold>``; rows of the prose are ``test_prose_<number>_<what>``.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

HERE = Path(__file__).parent


def _parts(nodeid: str) -> tuple[str, str]:
    name = nodeid.rpartition("::")[2].partition("[")[0].partition("@")[0].removeprefix("test_")
    if name.startswith("prose_"):
        _, number, what = name.split("_", 2)
        return f"Prose, row {number}", what.replace("_", " ")
    schema, _, what = name.partition("_")
    return schema, what.replace("_", " ")


def pytest_terminal_summary(terminalreporter: Any, config: pytest.Config) -> None:
    reports = [r for key in ("passed", "failed") for r in terminalreporter.stats.get(key, []) if r.when == "call"]
    ours = [r for r in reports if (Path(config.rootpath) / r.nodeid.partition("::")[0]).is_relative_to(HERE)]
    if not ours or len(ours) != len(reports):
        return  # only if no other tests run
    rows: dict[str, dict[str, list[bool]]] = {}
    for report in sorted(ours, key=lambda r: (r.location[0], r.location[1])):
        schema, what = _parts(report.nodeid)
        rows.setdefault(schema, {}).setdefault(what, []).append(report.passed)
    terminalreporter.section("the paper's specification")
    for schema, claims in rows.items():
        terminalreporter.write_line(schema)
        for what, held in claims.items():
            times = f" ({len(held)} cases)" if len(held) > 1 else ""
            terminalreporter.write_line(f"  {'holds ' if all(held) else 'BROKEN'} {what}{times}")
