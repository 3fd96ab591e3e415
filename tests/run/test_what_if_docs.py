"""The plans in docs/how-to/what-if.md are valid, and so are the rules and the planner of docs/how-to/twin.md."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import pytest

from fieldtwin.gateway.core.statemachine import decode_period
from fieldtwin.run.shadow.rules import PythonPlanner, load_planner, questions_of
from fieldtwin.run.what_if.plan import load_plans
from fieldtwin.twin.model.mape.messages import verdict
from fieldtwin.twin.model.mape.plan import RulePlanner
from fieldtwin.twin.model.model import DigitalModel
from fieldtwin.twin.site.system import load_system

DOCS = Path(__file__).resolve().parents[2] / "docs" / "how-to"
PAGE = DOCS / "what-if.md"


def test_the_plans_of_the_page(tmp_path: Path) -> None:
    [text] = re.findall(r"```yaml\n(what_if:.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    (tmp_path / "plans.yaml").write_text(text, encoding="utf-8")
    system, plans = load_plans(tmp_path / "plans.yaml")
    assert system == "observatory"
    assert [len(plan.require) for plan in plans] == [1, 1, 1]
    assert plans[2].faults[0]["device"] == "ctd"


def fences(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", (DOCS / "twin.md").read_text(encoding="utf-8"), re.DOTALL)


def test_the_rules_of_the_page_on_twins(tmp_path: Path) -> None:
    system, asked = load_system("observatory"), []
    for number, text in enumerate(fences("yaml")):
        (tmp_path / f"{number}.yaml").write_text(text, encoding="utf-8")
        planner, question, _ = load_planner(str(tmp_path / f"{number}.yaml"), system)
        assert isinstance(planner, RulePlanner)
        asked.append((len(planner.rules), question is not None, len(questions_of(planner))))
    assert asked == [(2, False, 0), (3, True, 1)]


def test_the_planner_of_the_page_on_twins(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    [text] = fences("python")
    (tmp_path / "planner.py").write_text(text, encoding="utf-8")
    monkeypatch.syspath_prepend(str(tmp_path))
    system = replace(load_system("observatory"), path=tmp_path / "observatory.yaml")
    planner, _, limits = load_planner("python: planner:Planner", system)
    assert limits["ctd.pressure"] == (0.0, 10.0)
    assert isinstance(planner, PythonPlanner)
    model, commanded = DigitalModel(), []
    for finding, subject in (("inside", "a"), ("outside", "a"), ("outside", "b"), ("inside", "a"), ("inside", "b")):
        command = planner.plan(verdict(finding, subject, "", 0), model)
        if command is not None:
            model.process_event(command)
            commanded.append(decode_period(command))
    assert commanded == [8, 4, 2, 1, 8]
    assert planner.plan(verdict("good", "a", "", 0), model) is None
