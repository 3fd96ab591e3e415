"""The scenario of a failed seed with the fewest random faults that break the same rule, which is run to confirm it."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from fieldtwin.results.model import ScenarioResult, Verdict
from fieldtwin.run.campaigns.campaign import Campaign, broken_by
from fieldtwin.run.campaigns.reruns import Shrunk
from fieldtwin.run.campaigns.shrink import as_scenario, same_failure
from fieldtwin.run.targets.virtual_scenario import run_virtual
from fieldtwin.scenarios.judging.fault_effects import fault_id
from fieldtwin.scenarios.language.form import Scenario, load_scenario

_KEPT = ("requirements", "start", "needs", "stopped", "refused", "probes")
"""Keys of a scenario that are copied unchanged into the scenario that is shrunk from it."""


def scenario_of(campaign: Campaign, small: Shrunk[ScenarioResult], folder: Path) -> str:
    """Return a scenario file for `folder`: the faults, the effects of the steps at their times, and the broken rule."""
    scenario = campaign.check()
    form, raw = scenario.form, scenario.file.data
    keys: dict[str, Any] = {key: raw[key] for key in _KEPT if key in raw}
    if form.prototype is not None:
        keys["prototype"] = _from(folder, scenario.path.parent / form.prototype)
    keys |= _rule(scenario, small.result)
    beside = scenario.path.parent / form.system
    system = _from(folder, beside) if beside.exists() else form.system
    return as_scenario(
        f"{form.scenario}: seed {small.seed}",
        system,
        small.seed,
        campaign.length_s(scenario),
        small.faults,
        [small.result.reason],
        _acts(scenario, small.result),
        keys,
    )


def _from(folder: Path, path: Path) -> str:
    try:
        return Path(os.path.relpath(path.resolve(), folder.resolve())).as_posix()
    except ValueError:  # on a different drive of Windows
        return str(path.resolve())


def _rule(scenario: Scenario, result: ScenarioResult) -> dict[str, Any]:
    """Return the broken rule as a key of a scenario file. An invariant needs no key: the system file already states it."""
    number = next((check.number for check in result.checks if check.verdict.bad), "")
    word, _, which = number.rpartition(" ")
    if word in ("always", "never", "within"):
        return {word: [scenario.file.data[word][int(which) - 1]]}
    return {} if "invariant" in number else {"judge": "run"}


def _acts(scenario: Scenario, result: ScenarioResult) -> list[tuple[float, dict[str, Any]]]:
    """Return the effects of the steps until the rule broke, with the time of each, in seconds of the run."""
    acts: list[tuple[float, dict[str, Any]]] = []
    for check in result.checks:
        if not check.number.isdigit():
            continue
        n, at_s = int(check.number) - 1, (check.since_ns or 0) / 1e9
        step, raw = scenario.form.steps[n], scenario.file.data["steps"][n]
        if step.fault is not None:
            acts.append((at_s, {"fault": {"id": fault_id(n, step), **step.fault}}))
        elif step.send is not None or step.set is not None or step.clear is not None:
            acts.append((at_s, dict(raw)))
    return acts


def confirm(path: Path, campaign: Campaign, small: Shrunk[ScenarioResult]) -> ScenarioResult | None:
    """Run the scenario in `path`; return its result if it breaks the rule that the seed broke, else None."""
    result = run_virtual(load_scenario(path, campaign.profiles))
    confirmed = result.verdict is not Verdict.PASSED and same_failure(broken_by(small.result), broken_by(result))
    return result if confirmed else None
