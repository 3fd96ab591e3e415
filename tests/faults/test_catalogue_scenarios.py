"""Every row of the two catalogues of edge cases that concerns the drivers, as a scenario in virtual time: the real gateway, PLC
and emulators, a fault on the wire, and what the wire, the tag's quality and the program show, and how soon all is well again."""

from __future__ import annotations

from pathlib import Path

import pytest

from fieldtwin.report.model import Verdict
from fieldtwin.running.virtual_scenario import run_virtual
from fieldtwin.scenarios.form import load_scenario

FOLDER = Path(__file__).parent / "scenarios"
FILES = sorted(FOLDER.glob("*.scenario.yaml"))


@pytest.mark.parametrize("path", FILES, ids=lambda p: p.name.removesuffix(".scenario.yaml"))
def test_scenario(path: Path) -> None:
    result = run_virtual(load_scenario(path))
    assert result.verdict is Verdict.PASSED, result.checks[-1]
    assert [r for r in result.requirements if path.name.startswith(r)]
