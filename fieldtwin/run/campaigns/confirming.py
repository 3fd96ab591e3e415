"""Confirm a scenario that was written to reproduce a failure: it has to fail in the same way."""

from __future__ import annotations

from pathlib import Path

from fieldtwin.results.model import ScenarioResult, Verdict
from fieldtwin.run.campaigns.many_seeds import SeedResult
from fieldtwin.run.campaigns.shrink import same_failure
from fieldtwin.run.targets.virtual_scenario import run_virtual
from fieldtwin.scenarios.language.form import load_scenario

CONFIRMED = "confirmed: this scenario fails like the run"


def confirm_run(path: Path, found: SeedResult, profiles: tuple[Path, ...]) -> str:
    """Run the scenario in `path`, and return a sentence that states whether it fails with an error of the run for which it was
    written.
    """
    result = run_virtual(load_scenario(path, profiles))
    bad = [check for check in result.checks if check.verdict.bad]
    told = [part for check in bad for part in (*check.got.split("; "), f"{check.number}: {check.text}")]
    wanted = [part for error in found.errors for part in error.split("; ")]
    if result.verdict.bad and same_failure(wanted, told):
        return CONFIRMED
    return f"not confirmed: {ended(result)}; use `--seed {found.seed}` with the options of this run instead"


def ended(result: ScenarioResult) -> str:
    """Return a sentence about the result of a scenario that should have failed like the run that it reproduces."""
    if result.verdict is Verdict.PASSED:
        return "this scenario passes"
    return f"this scenario has a different result ({result.verdict.value}: {result.reason})"
