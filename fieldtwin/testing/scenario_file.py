"""A scenario file as a pytest item: one test, whose outcome is the scenario's verdict.

PASSED is a pass. SKIPPED (the target lacks an ability that the scenario needs) is a skip, with the reason. FAILED is a
failure, and so are INCONCLUSIVE and ERROR: a scenario that did not pass must not look as if it had.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from fieldtwin.scenarios.language.file_name import case_of
from fieldtwin.testing.outcome import ScenarioOutcome, run_scenario
from fieldtwin.testing.runner import FieldtwinRefused, FieldtwinUnavailable, command_of

ABOUT = ("case", "role", "impact")


class NotPassed(Exception):
    """Raised for a scenario that did not pass."""

    def __init__(self, outcome: ScenarioOutcome) -> None:
        super().__init__(outcome.verdict)
        self.outcome = outcome


class ScenarioFile(pytest.File):
    """A scenario file that pytest has collected."""

    def collect(self) -> Iterator[ScenarioItem]:
        made: ScenarioItem = ScenarioItem.from_parent(self, name=case_of(self.path))
        yield made


class ScenarioItem(pytest.Item):
    """The test of a scenario file: it runs the scenario."""

    def runtest(self) -> None:
        config = self.config
        outcome = run_scenario(
            command_of(config.getoption("--fieldtwin-command")),
            self.path,
            seed=config.getoption("--fieldtwin-seed"),
            target=config.getoption("--fieldtwin-target"),
            profiles=[str(p) for p in config.getini("fieldtwin_profiles")],
            trust=config.getoption("--fieldtwin-trust"),
        )
        self.user_properties += [(name, value) for name in ABOUT if (value := getattr(outcome, name))]
        self.user_properties += [("requirement", id) for id in outcome.requirements]
        self.user_properties += [("fieldtwin verdict", outcome.verdict)]
        self.user_properties += [("seed", outcome.seed)] if outcome.seed is not None else []
        if outcome.verdict == "skipped":
            pytest.skip(outcome.reason or "the target cannot do it")
        if not outcome.passed:
            raise NotPassed(outcome)

    def repr_failure(self, excinfo: pytest.ExceptionInfo[BaseException], style: Any = None) -> Any:
        if isinstance(excinfo.value, NotPassed):
            return str(excinfo.value.outcome)
        if isinstance(excinfo.value, FieldtwinRefused | FieldtwinUnavailable):
            return f"fieldtwin: {excinfo.value}"
        return super().repr_failure(excinfo, style)

    def reportinfo(self) -> tuple[Path, int, str]:
        return self.path, 0, f"scenario {self.name}"
