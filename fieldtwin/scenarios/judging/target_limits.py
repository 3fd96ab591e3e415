"""Checks whether a target can run a scenario, and whether the user permits it, without running anything."""

from __future__ import annotations

from collections.abc import Collection

from fieldtwin.conformance.core.case import Impact
from fieldtwin.scenarios.bench import Can
from fieldtwin.scenarios.language.about import impacts
from fieldtwin.scenarios.language.form import Scenario, needs_of

NO_FRESH_START = (
    "`start: fresh` resets PLC, simulation and devices, which is possible only where the devices are simulated "
    "and the PLC is fieldtwin's"
)


def refusal(scenario: Scenario, target: str, can: Collection[Can], allowed: Impact) -> str:
    """Return why a target lacks a capability for the scenario, or why its impact level is not permitted; empty if the scenario
    may run.
    """
    lacking = [need.value for need in scenario.needs if need not in can]
    if lacking:
        steps = [
            str(n)
            for n, step in enumerate(scenario.form.steps, 1)
            if any(need.value in lacking for need in needs_of(step))
        ]
        said = f" (step{'s' if len(steps) > 1 else ''} {', '.join(steps[:5])})" if steps else ""
        why = f": {NO_FRESH_START}" if Can.FRESH_START.value in lacking else ""
        return f"the target {target} cannot {', '.join(lacking)}{said}{why}"
    for impact, what in impacts(scenario):
        if impact.rank > allowed.rank:
            said = f"{what} has the impact level {impact.value}, and the target {target} allows {allowed.value}"
            return f"{said} (--allow {impact.value})"
    return ""
