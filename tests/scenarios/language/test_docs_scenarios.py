"""The scenarios on docs/reference/scenarios.md and docs/how-to/own-controller.md are valid; the first one runs and passes."""

from __future__ import annotations

import re
from pathlib import Path

from fieldtwin.results.model import Verdict
from fieldtwin.run.targets.virtual_scenario import run_virtual
from fieldtwin.scenarios.language.form import load_scenario
from fieldtwin.scenarios.language.words import WORDS, ScenarioForm

DOCS = Path(__file__).resolve().parents[3] / "docs"
PAGE = "".join((DOCS / page).read_text() for page in ("reference/scenarios.md", "how-to/own-controller.md"))

BLOCKS = re.findall(r"```yaml\n(.*?)```", PAGE, re.DOTALL)


def test_the_probe_is_one(tmp_path: Path) -> None:
    assert len(BLOCKS) == 3
    path = tmp_path / "x.scenario.yaml"
    path.write_text(f"scenario: x\nsystem: observatory\n{BLOCKS[1]}steps: [{{expect: {{that: 'crane.height > 0'}}}}]\n")
    assert load_scenario(path).probes[0].names == ["crane.height", "crane.moving"]


def test_the_scenario_for_a_users_controller_uses_probes_only(tmp_path: Path) -> None:
    path = tmp_path / "x.scenario.yaml"
    path.write_text(f"scenario: x\nsystem: observatory\n{BLOCKS[2]}")
    scenario = load_scenario(path)
    assert scenario.used == {"mine.alarm"}
    assert scenario.probes[0].at({"FIELDTWIN_LAN_URL": "tcp://127.0.0.1:1502"}).endpoint is not None


def test_the_example_passes(tmp_path: Path) -> None:
    text = BLOCKS[0]
    path = tmp_path / "x.scenario.yaml"
    path.write_text(text)
    result = run_virtual(load_scenario(path))
    assert result.verdict is Verdict.PASSED, result.checks[-1]


def test_every_key_and_step_is_on_the_page() -> None:
    for name, key in ScenarioForm.model_fields.items():
        assert f"`{key.alias or name}" in PAGE, name
    for word in WORDS:
        assert f"`{word}: " in PAGE, word
