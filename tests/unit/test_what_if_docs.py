"""The plans that docs/what-if.md shows can be read."""

from __future__ import annotations

import re
from pathlib import Path

from fieldtwin.whatif.plan import load_plans

PAGE = Path(__file__).resolve().parents[2] / "docs" / "what-if.md"


def test_the_plans_of_the_page(tmp_path: Path) -> None:
    [text] = re.findall(r"```yaml\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    (tmp_path / "plans.yaml").write_text(text, encoding="utf-8")
    system, plans = load_plans(tmp_path / "plans.yaml")
    assert system == "observatory"
    assert [len(plan.require) for plan in plans] == [1, 1, 1]
    assert plans[2].faults[0]["device"] == "modem"
